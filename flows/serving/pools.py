"""Work pools and deployments as described in `deploy/`."""

import copy
import sys
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import Field, TypeAdapter, ValidationError

from dg4d_lib.errors import BadInput
from steps.contract import Frozen

SOURCE = Path(__file__).parents[2] / "deploy"
DEPLOY = SOURCE if SOURCE.is_dir() else Path(sys.prefix) / "share" / "dg4d"  # of a source tree, or installed
DEPLOYMENTS = DEPLOY / "prefect.yaml"

Json = dict[str, Any]


class Pool(Frozen):
    """Work pool.

    Attributes:
        type: type of its workers.
        limit: concurrency limit of the pool.
        per_worker: concurrency limit of one worker; None: that of the pool.
        description: text for the UI.
        variables: defaults of job variables.
        job: patches merged into the job configuration of the worker type.
    """

    type: Literal["process", "docker", "kubernetes"]
    limit: int
    per_worker: int | None = Field(None, ge=1)
    description: str
    variables: dict[str, Any] = Field({})
    job: tuple[dict[str, Any], ...] = ()

    def template(self, default: Json) -> Json:
        """Return the base job template.

        Args:
            default: template of the worker type.

        Raises:
            BadInput: the worker type does not have a variable.
        """
        template = copy.deepcopy(default)
        known = template["variables"]["properties"]
        if unknown := sorted(set(self.variables) - set(known)):
            raise BadInput(f"a pool of type {self.type} has no variable {unknown[0]!r}; it has: {', '.join(known)}")
        for name, value in self.variables.items():
            known[name]["default"] = value
        for patch in self.job:
            _merge(template["job_configuration"], patch)
        return template


def read_pools(file: Path = DEPLOY / "pools.yaml") -> dict[str, Pool]:
    """Return the pools by name.

    Raises:
        BadInput: the file is missing or invalid.
    """
    try:
        return TypeAdapter(dict[str, Pool]).validate_python(_read(file))
    except ValidationError as error:
        raise BadInput(f"{file}: {error}") from error


def read_deployments(file: Path = DEPLOYMENTS) -> list[Json]:
    """Return the deployments of a `prefect.yaml`; raises BadInput if it cannot be read."""
    deployments: list[Json] = _read(file)["deployments"]
    return deployments


def _read(file: Path) -> Json:
    try:
        content: Json = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, yaml.YAMLError) as error:
        raise BadInput(
            f"{file} cannot be read: {error}; deployments are described in the source tree of dg4d"
        ) from error
    return content


def _merge(tree: Json, patch: Json) -> None:
    """Merge `patch` into `tree`; lists of the same key are merged item by item."""
    for key, value in patch.items():
        below = tree.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            _merge(below, value)
        elif isinstance(value, list) and isinstance(below, list):
            for item, change in zip(below, value, strict=True):
                _merge(item, change)
        else:
            tree[key] = copy.deepcopy(value)
