"""What workers make of our pools: the settings of a container, the manifest of a job. No engine, no cluster."""

import asyncio
import functools
import json
import types
from pathlib import Path
from typing import Any

import prefect
from prefect.client.schemas.objects import FlowRun
from prefect_docker.worker import DockerWorker, DockerWorkerJobConfiguration
from prefect_kubernetes.worker import KubernetesWorkerJobConfiguration

from flows.serving.pools import Pool

REGISTRY = Path(prefect.__file__).parent / "server/api/collections_data/views/aggregate-worker-metadata.json"
RUN = FlowRun(id="00000000-0000-4000-8000-000000000000", name="example", flow_id="00000000-0000-4000-8000-000000000001")


@functools.cache
def default_templates() -> dict[str, dict[str, Any]]:
    """The base job templates that the server knows, by kind of worker."""
    collections = json.loads(REGISTRY.read_text(encoding="utf-8")).values()
    return {kind: one["default_base_job_configuration"] for workers in collections for kind, one in workers.items()}


def container(pool: Pool) -> dict[str, Any]:
    """What a docker worker asks its engine for."""
    configuration = _configuration(DockerWorkerJobConfiguration, pool)
    engine = types.SimpleNamespace(version=lambda: {"Version": "27.0.0"})
    return DockerWorker._build_container_settings(None, engine, configuration)  # type: ignore[arg-type]


def job(pool: Pool) -> dict[str, Any]:
    """What a kubernetes worker asks its cluster for."""
    manifest: dict[str, Any] = _configuration(KubernetesWorkerJobConfiguration, pool).job_manifest
    return manifest


def _configuration(kind: Any, pool: Pool) -> Any:
    template = pool.template(default_templates()[pool.type])
    configuration = asyncio.run(kind.from_template_and_values(template, {}, client=types.SimpleNamespace()))
    configuration.prepare_for_flow_run(RUN)
    return configuration
