"""Work pools and deployments as `deploy/` describes them."""

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
    """A work pool.

    Attributes:
        type: the kind of its workers.
        limit: runs at a time, of all workers together.
        per_worker: runs at a time of one worker; None: as many as the pool allows.
        description: for people.
        variables: defaults of the job variables.
        job: each is put over the job that such a worker makes.
    """

    type: Literal["process", "docker", "kubernetes"]
    limit: int
    per_worker: int | None = Field(None, ge=1)
    description: str
    variables: dict[str, Any] = Field({})
    job: tuple[dict[str, Any], ...] = ()

    def template(self, default: Json) -> Json:
        """The base job template.

        Args:
            default: that of the kind of worker.

        Raises:
            BadInput: a variable is not one of the worker's.
        """
        template = copy.deepcopy(default)
        known = template["variables"]["properties"]
        if unknown := sorted(set(self.variables) - set(known)):
            raise BadInput(f"a pool of type {self.type} has no variable {unknown[0]!r}; it has: {', '.join(known)}")
        for name, value in self.variables.items():
            known[name]["default"] = value
        for patch in self.job:
            _put_over(template["job_configuration"], patch)
        return template


def read_pools(file: Path = DEPLOY / "pools.yaml") -> dict[str, Pool]:
    """The pools by name.

    Raises:
        BadInput: the file is not there, or says something else.
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


def _put_over(tree: Json, patch: Json) -> None:
    """Merge `patch` into `tree`, the items of a list that is there already one by one."""
    for key, value in patch.items():
        below = tree.get(key)
        if isinstance(value, dict) and isinstance(below, dict):
            _put_over(below, value)
        elif isinstance(value, list) and isinstance(below, list):
            for item, change in zip(below, value, strict=True):
                _put_over(item, change)
        else:
            tree[key] = copy.deepcopy(value)
