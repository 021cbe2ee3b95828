"""Cache policy of steps: request digests as keys, checked against the artifacts in the store.

Prefect's own policies hash arguments and source text, which miss weights and code of the step; its lock files outlive
their process.
"""

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefect.cache_policies import CachePolicy
from prefect.context import TaskRunContext

from flows import home
from flows.engine.file_locks import FileLocks
from flows.engine.records import record_key, recorded
from flows.engine.shared_results import fetch_result
from steps.contract import StepRequest
from steps.store.artifact_store import StoreUnreachable


@dataclass
class RequestPolicy(CachePolicy):
    """Cache key of a task that runs a step: the digest of its request. Drops records that are broken.

    Attributes:
        request_for: returns the request, given the name of the task and its arguments.
    """

    request_for: Callable[[str, Mapping[str, Any]], StepRequest] | None = None

    def compute_key(
        self, task_ctx: TaskRunContext, inputs: dict[str, Any], flow_parameters: dict[str, Any], **_: Any
    ) -> str | None:
        """Return the name of the request's record."""
        assert self.request_for is not None  # the base class has defaults, so this field needs one
        key = record_key(self.request_for(task_ctx.task.name, inputs))
        record = home.records() / key
        with suppress(StoreUnreachable):  # a record that cannot be checked is used
            fetch_result(key, record)
            if record.exists() and recorded(record, home.store()) is None:
                self._drop(record, key)
        return key

    def _drop(self, record: Path, key: str) -> None:
        """Remove a broken record, unless another process is writing it."""
        lock = self.lock_manager
        holder = f"heal-{threading.get_ident()}"
        if not isinstance(lock, FileLocks):
            record.unlink(missing_ok=True)
        elif lock.acquire_lock(key, holder, acquire_timeout=0):
            try:
                if recorded(record, home.store()) is None:
                    record.unlink(missing_ok=True)
            finally:
                lock.release_lock(key, holder)
