"""Pools and deployments: what a worker makes of them, and mistakes that a server would take without a word."""

import re
from pathlib import Path, PurePosixPath
from typing import Any

import kubernetes_validate
import pytest
import rendering
import yaml
from prefect.flows import load_flow_from_entrypoint
from prefect.utilities.callables import parameter_schema
from prefect.utilities.schema_tools.validation import validate

import flows
from dg4d_lib.errors import BadInput
from flows.engine.resources import CORES_PER_STEP
from flows.serving.pools import DEPLOYMENTS, Pool, read_deployments, read_pools
from flows.studio.submission import GPU

POOLS = read_pools()
KUBERNETES = "1.33"


def pools_of(kind: str) -> list[Pool]:
    return [pool for pool in POOLS.values() if pool.type == kind]


def changed(tmp_path: Path, old: str, new: str, file: Path = DEPLOYMENTS) -> Path:
    text = file.read_text(encoding="utf-8")
    assert old in text
    path = tmp_path / file.name
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


def test_every_flow_is_deployed_in_every_pool_and_only_items_go_to_the_fleet() -> None:
    deployments = read_deployments()
    flows = {deployment["entrypoint"].rpartition(".")[2] for deployment in deployments}
    assert flows == {"picture_to_4d", "video_to_4d", "model_to_4d", "catalog_to_4d", "benchmark", "item_to_4d"}
    where = {(one["entrypoint"].rpartition(".")[2], one["work_pool"]["name"]) for one in deployments}
    assert where == {(flow, pool) for flow in flows for pool in set(POOLS) - {"fleet"}} | {("item_to_4d", "fleet")}


def test_a_deployment_is_known_by_its_name_alone_and_a_flow_by_its_function() -> None:
    deployments = read_deployments()
    names = [deployment["name"] for deployment in deployments]
    assert len(set(names)) == len(names)
    assert {"Picture to 4D", "Video to 4D", "Catalog to 4D", "Benchmark", "Item to 4D on a fleet"} <= set(names)
    for deployment in deployments:
        flow = load_flow_from_entrypoint(deployment["entrypoint"])
        assert flow.name == deployment["entrypoint"].rpartition(".")[2].replace("_", "-")
        assert deployment["tags"] == [flow.name.removesuffix("-to-4d")]


def test_the_studio_starts_runs_of_the_pools_of_processes() -> None:
    pool = {one["name"]: one["work_pool"]["name"] for one in read_deployments()}
    for title in ("Picture", "Video", "Model", "Catalog"):
        assert pool[f"{title} to 4D"] == "process-cpu" and pool[f"{title} to 4D{GPU}"] == "process-gpu"


def test_no_two_flows_have_one_name() -> None:
    sources = (file.read_text(encoding="utf-8") for file in Path(flows.__file__).parent.rglob("*.py"))
    names = [name for source in sources for name in re.findall(r"@flow\(\s*name=\"?([\w-]+)", source)]
    assert len(names) >= 11 and len(set(names)) == len(names)


def test_one_catalog_at_a_time_runs_in_a_pool() -> None:
    for deployment in read_deployments():
        limited = deployment["entrypoint"].endswith(".catalog_to_4d")
        assert (deployment.get("concurrency_limit", {}).get("limit") == 1) == limited


def test_parameters_of_deployments_triggers_and_schedules_fit_their_flows() -> None:
    for deployment in read_deployments():
        schema: dict[str, Any] = parameter_schema(load_flow_from_entrypoint(deployment["entrypoint"])).model_dump()
        for given in (deployment, *deployment.get("schedules", []), *deployment.get("triggers", [])):
            parameters = given.get("parameters", {})
            assert set(parameters) <= set(schema["properties"])
        assert not validate(deployment.get("parameters", {}), schema, raise_on_error=False, ignore_required=True)


def test_a_misspelt_variable_of_a_pool_is_found() -> None:
    pool = POOLS["docker-cpu"].model_copy(update={"variables": {"mem_limits": "8g"}})
    with pytest.raises(BadInput, match="no variable 'mem_limits'"):
        pool.template(rendering.default_templates()["docker"])


def test_a_pool_of_an_unknown_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"process-cpu"):
        read_pools(changed(tmp_path, "type: process", "type: proces", DEPLOYMENTS.with_name("pools.yaml")))


@pytest.mark.parametrize("pool", pools_of("docker"))
def test_a_container_is_confined_and_limited(pool: Pool) -> None:
    settings = rendering.container(pool)
    assert settings["image"].startswith("dg4d/flows")
    assert settings["mem_limit"].endswith("g")
    assert settings["cap_drop"] == ["ALL"] and not settings["privileged"]
    assert settings["security_opt"] == ["no-new-privileges"]
    assert settings["environment"]["PREFECT_HOME"] == "/tmp/prefect"  # not that of the worker
    assert settings["environment"]["DG4D_HOME"] == "/data/home"
    assert settings["volumes"] == ["dg4d-data:/data"]


def test_only_the_gpu_pool_asks_for_a_gpu() -> None:
    gpu = [{"Driver": "nvidia", "Count": 1, "Capabilities": [["gpu"]]}]
    assert rendering.container(POOLS["docker-gpu"])["device_requests"] == gpu
    assert "device_requests" not in rendering.container(POOLS["docker-cpu"])
    limits = {kind: job_container(POOLS[f"kubernetes-{kind}"])["resources"]["limits"] for kind in ("cpu", "gpu")}
    assert limits["gpu"]["nvidia.com/gpu"] == 1
    assert "nvidia.com/gpu" not in limits["cpu"]
    assert POOLS["process-gpu"].limit == POOLS["docker-gpu"].limit == 1  # one GPU, one run


@pytest.mark.parametrize("pool", pools_of("kubernetes"))
def test_a_job_is_valid_confined_and_limited(pool: Pool) -> None:
    manifest = rendering.job(pool)
    for name in ("completions", "parallelism"):  # Prefect insists on them where they mean nothing; clusters drop them
        del manifest["spec"]["template"]["spec"][name]
    kubernetes_validate.validate(manifest, KUBERNETES, strict=True)
    pod, (container,) = manifest["spec"]["template"]["spec"], [job_container(pool)]
    assert pod["securityContext"]["runAsNonRoot"] and not pod["automountServiceAccountToken"]
    assert container["securityContext"] == {"allowPrivilegeEscalation": False, "capabilities": {"drop": ["ALL"]}}
    assert {"cpu", "memory"} <= set(container["resources"]["limits"])
    assert container["envFrom"][1] == {"secretRef": {"name": "dg4d"}}
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    assert environment["PREFECT_HOME"] == "/tmp/prefect" and environment["DG4D_HOME"] == "/data/home"
    assert manifest["spec"]["backoffLimit"] == 0  # Prefect counts attempts


@pytest.mark.parametrize("pool", pools_of("kubernetes"))
def test_the_slots_of_a_job_are_its_own_and_fit_its_cpus(pool: Pool) -> None:
    container = job_container(pool)
    environment = {entry["name"]: entry.get("value") for entry in container["env"]}
    mounted = [PurePosixPath(mount["mountPath"]) for mount in container["volumeMounts"]]
    slots = PurePosixPath(environment["DG4D_SLOTS"])
    assert slots.is_absolute() and mounted and not any(slots.is_relative_to(place) for place in mounted)
    assert int(environment["DG4D_CPUS"]) == int(container["resources"]["limits"]["cpu"]) // CORES_PER_STEP


@pytest.mark.parametrize("pool", pools_of("docker"))
def test_containers_of_one_machine_share_its_slots_and_pull_no_image(pool: Pool) -> None:
    assert "DG4D_SLOTS" not in rendering.container(pool)["environment"]
    assert pool.variables["image_pull_policy"] == "Never"


def job_container(pool: Pool) -> dict[str, Any]:
    (container,) = rendering.job(pool)["spec"]["template"]["spec"]["containers"]
    return dict(container)


def test_anchors_of_the_file_are_plain_yaml_to_prefect() -> None:
    assert all("<<" not in deployment for deployment in yaml.safe_load(DEPLOYMENTS.read_text())["deployments"])
