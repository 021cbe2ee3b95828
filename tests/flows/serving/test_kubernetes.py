"""A worker of deploy/k8s at its work: what it wants of a cluster is what its role allows, and what its files name."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import kubernetes_validate
import pytest
import yaml
from prefect.client.orchestration import get_client
from prefect.settings import PREFECT_API_URL
from stand_in_cluster import Asked, Cluster, cluster
from waiting import wait_until

from flows.serving import registering
from flows.serving.pools import DEPLOY, read_pools
from flows.serving.server import Server

pytestmark = pytest.mark.slow  # a cluster and a worker take half a minute to start

MANIFESTS: list[dict[str, Any]] = [
    document
    for file in sorted((DEPLOY / "k8s").glob("*.yaml"))
    for document in yaml.safe_load_all(file.read_text(encoding="utf-8"))
]
SECRETS = {"dg4d"}  # kustomization.yaml says how to make it; runs need no other
PASSWORD = "somebody:a-secret-word"


def named(kind: str, name: str) -> dict[str, Any]:
    (found,) = (one for one in MANIFESTS if one["kind"] == kind and one["metadata"]["name"] == name)
    return found


def names(kind: str) -> set[str]:
    return {one["metadata"]["name"] for one in MANIFESTS if one["kind"] == kind}


@pytest.fixture(scope="module")
def busy(server: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cluster]:
    """A cluster of which the worker of the pool kubernetes-cpu has wanted a job, and looked at what becomes of it."""
    place = tmp_path_factory.mktemp("cluster")
    api_url = str(PREFECT_API_URL.value())
    (container,) = named("Deployment", "worker-cpu")["spec"]["template"]["spec"]["containers"]
    given = {entry["name"]: entry.get("value", PASSWORD) for entry in container["env"]}
    settings = {**named("ConfigMap", "dg4d")["data"], **given, "PREFECT_API_URL": api_url}
    settings["PREFECT_API_AUTH_STRING"] = server.auth_string()
    with pytest.MonkeyPatch.context() as patch, get_client(sync_client=True) as client:
        patch.setenv("PREFECT_API_URL", api_url)
        registering.register(read_pools(), ["kubernetes-cpu"])
        deployment = client.read_deployment_by_name("picture-to-4d/Picture to 4D on Kubernetes")
        run = client.create_flow_run_from_deployment(deployment.id, parameters={"picture": "in.png", "out": "out"})
        with cluster(named("Role", "dg4d-worker")) as api:
            (place / "access").write_text(yaml.safe_dump(api.access), encoding="utf-8")
            worker = subprocess.Popen(
                [sys.executable, "-m", *container["command"][:-1]],  # its health is asked for at a fixed port
                env={**os.environ, **settings, "KUBECONFIG": str(place / "access"), "PREFECT_HOME": str(place)},
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            try:
                wait_until(lambda: api.created and len({*api.allowed, *api.forbidden}) >= 5)
            finally:
                worker.kill()  # it would wait for what it watches
                worker.wait()
                client.delete_flow_run(run.id)
            yield api


def test_a_worker_wants_nothing_that_its_role_forbids(busy: Cluster) -> None:
    looks = {Asked(verb, *what, "dg4d") for verb in ("list", "watch") for what in (("", "pods"), ("batch", "jobs"))}
    assert busy.forbidden == []
    assert set(busy.allowed) == {*looks, Asked("create", "batch", "jobs", "dg4d")}


def test_the_job_of_a_run_is_valid_and_names_what_there_is(busy: Cluster) -> None:
    (job,) = busy.created
    pod = job["spec"]["template"]["spec"]
    for name in ("completions", "parallelism"):  # Prefect insists on them where they mean nothing; clusters drop them
        pod.pop(name)
    kubernetes_validate.validate(job, "1.33", strict=True)
    (container,) = pod["containers"]
    assert container["args"] == ["prefect", "flow-run", "execute"]
    assert pod["serviceAccountName"] in names("ServiceAccount")
    assert {volume["persistentVolumeClaim"]["claimName"] for volume in pod["volumes"]} <= names("PersistentVolumeClaim")
    assert {one["configMapRef"]["name"] for one in container["envFrom"] if "configMapRef" in one} <= names("ConfigMap")
    assert {one["secretRef"]["name"] for one in container["envFrom"] if "secretRef" in one} <= SECRETS
    assert job["metadata"]["namespace"] in names("Namespace")


def test_the_job_of_a_run_has_the_name_of_a_secret_and_not_its_content(busy: Cluster, server: Server) -> None:
    (job,) = busy.created
    assert server.auth_string().partition(":")[2] not in json.dumps(job)
    (container,) = job["spec"]["template"]["spec"]["containers"]
    (entry,) = (entry for entry in container["env"] if entry["name"] == "PREFECT_API_AUTH_STRING")
    assert entry["valueFrom"] == {"secretKeyRef": {"name": "dg4d", "key": "PREFECT_API_AUTH_STRING"}}
