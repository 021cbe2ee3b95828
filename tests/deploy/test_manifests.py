"""deploy/compose.yaml and deploy/k8s: valid by their schemas, confined, and without a secret in them."""

import re
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from compose_spec import PyCompose
from yamllint import linter
from yamllint.config import YamlLintConfig

DEPLOY = Path(__file__).parents[2] / "deploy"
FILES = sorted(DEPLOY.rglob("*.yaml"))
COMPOSE: dict[str, Any] = yaml.safe_load((DEPLOY / "compose.yaml").read_text(encoding="utf-8"))
SERVICES: dict[str, Any] = COMPOSE["services"]
LASTING = [name for name, service in SERVICES.items() if service["restart"] == "unless-stopped"]
MANIFESTS: list[dict[str, Any]] = [
    document
    for file in sorted((DEPLOY / "k8s").glob("*.yaml"))
    if file.name != "kustomization.yaml"
    for document in yaml.safe_load_all(file.read_text(encoding="utf-8"))
]
PODS = {
    document["metadata"]["name"]: document["spec"]["template"]
    for document in MANIFESTS
    if "template" in document.get("spec", {})
}
SECRET = re.compile(r"PASSWORD|SECRET|AUTH|KEY")
LINT = "{extends: default, rules: {line-length: {max: 130}, document-start: disable, braces: {max-spaces-inside: 1}}}"


class Plain(yaml.SafeDumper):
    """Writes anchors out, for readers that know none."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(DEPLOY)))
def test_yaml_is_well_written(file: Path) -> None:
    assert not list(linter.run(file.read_text(encoding="utf-8"), YamlLintConfig(LINT)))


def test_the_compose_file_is_valid() -> None:
    assert len(PyCompose.from_yaml(yaml.dump(COMPOSE, Dumper=Plain)).services) == len(SERVICES)


def test_a_misspelt_key_of_a_service_would_be_found() -> None:
    wrong = {**COMPOSE, "services": {"server": {"image": "x", "healtcheck": {}}}}
    with pytest.raises(ValueError, match="healtcheck"):
        PyCompose.from_yaml(yaml.dump(wrong, Dumper=Plain))


def test_only_the_server_is_reached_from_outside_and_only_from_this_machine() -> None:
    assert {name: service["ports"] for name, service in SERVICES.items() if "ports" in service} == {
        "server": ["127.0.0.1:4200:4200"]
    }


@pytest.mark.parametrize("name", SERVICES)
def test_a_service_is_confined(name: str) -> None:
    service = SERVICES[name]
    assert service["cap_drop"] == ["ALL"]
    if name == "volumes":  # gives new volumes to who may write there, and ends
        assert service["cap_add"] == ["CHOWN"] and service["network_mode"] == "none" and service["restart"] == "no"
        return
    assert service["read_only"] and service["security_opt"] == ["no-new-privileges:true"]
    assert {"cpus", "memory"} <= set(service["deploy"]["resources"]["limits"])
    assert service.get("user", "") != "root"
    assert service["image"].startswith("dg4d/") or re.search(r":[\w.-]*\d[\w.-]*$", service["image"])


@pytest.mark.parametrize("name", LASTING)
def test_a_lasting_service_has_a_health_check(name: str) -> None:
    assert SERVICES[name]["healthcheck"]["test"][0] == "CMD"


def test_a_server_that_cannot_write_its_own_files_has_another_place_for_its_pages() -> None:
    name, (container,) = "PREFECT_SERVER_UI_STATIC_DIRECTORY", PODS["server"]["spec"]["containers"]
    assert SERVICES["server"]["read_only"] and container["securityContext"]["readOnlyRootFilesystem"]
    assert SERVICES["server"]["environment"][name].startswith("/tmp/")
    assert {"name": name, "value": SERVICES["server"]["environment"][name]} in container["env"]
    assert {"name": "scratch", "mountPath": "/tmp"} in container["volumeMounts"]


@pytest.mark.parametrize("name", ["worker-cpu", "worker-gpu"])
def test_a_worker_that_cannot_write_its_own_files_has_another_place_for_compiled_kernels(name: str) -> None:
    worker = SERVICES[name]
    assert worker["read_only"] and worker["volumes"] == ["data:/data"]
    assert worker["environment"]["NUMBA_CACHE_DIR"].startswith("/data/")


def test_redis_answers_other_machines_without_its_image_saying_so() -> None:
    for words in (SERVICES["redis"]["command"], PODS["redis"]["spec"]["containers"][0]["args"]):
        assert words[words.index("--protected-mode") + 1] == "no"


def test_secrets_of_the_compose_file_come_from_outside_and_must_be_given() -> None:
    given = [
        value
        for service in SERVICES.values()
        for name, value in service.get("environment", {}).items()
        if SECRET.search(name)
    ]
    assert len(given) > 8
    assert all(re.fullmatch(r"\$\{DG4D_\w+:\?[^}]+\}", value) for value in given)


def test_the_gpu_worker_reserves_one_gpu_and_waits_for_its_profile() -> None:
    (device,) = SERVICES["worker-gpu"]["deploy"]["resources"]["reservations"]["devices"]
    assert device == {"driver": "nvidia", "count": 1, "capabilities": ["gpu"]}
    assert SERVICES["worker-gpu"]["profiles"] == ["gpu"]


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda one: f"{one['kind']}-{one['metadata']['name']}")
def test_a_manifest_is_valid(manifest: dict[str, Any]) -> None:
    kubernetes_validate.validate(manifest, "1.33", strict=True)
    assert manifest["kind"] == "Namespace" or manifest["metadata"]["namespace"] == "dg4d"


def test_a_wrong_type_in_a_manifest_would_be_found() -> None:
    service = next(manifest for manifest in MANIFESTS if manifest["kind"] == "Service")
    wrong = {**service, "spec": {**service["spec"], "ports": [{"port": "http"}]}}
    with pytest.raises(kubernetes_validate.ValidationError, match="http"):
        kubernetes_validate.validate(wrong, "1.33", strict=True)


@pytest.mark.parametrize("name", PODS)
def test_a_pod_is_confined_and_limited(name: str) -> None:
    pod = PODS[name]["spec"]
    assert pod["securityContext"]["runAsNonRoot"]
    (container,) = pod["containers"]
    assert container["securityContext"] == {
        "allowPrivilegeEscalation": False,
        "readOnlyRootFilesystem": True,
        "capabilities": {"drop": ["ALL"]},
    }
    assert {"cpu", "memory"} == set(container["resources"]["limits"]) == set(container["resources"]["requests"])
    assert name == "register" or "livenessProbe" in container
    for variable in container.get("env", []):
        if SECRET.search(variable["name"]) and not variable["name"].endswith(("_SECRET_NAME", "_SECRET_KEY")):
            assert "secretKeyRef" in variable["valueFrom"]


def test_pods_are_found_by_their_services() -> None:
    wanted = [manifest["spec"]["selector"] for manifest in MANIFESTS if manifest["kind"] == "Service"]
    labels = [pod["metadata"]["labels"] for pod in PODS.values()]
    assert len(wanted) == 4 and all(selector in labels for selector in wanted)


def test_the_kustomization_names_every_manifest() -> None:
    named = yaml.safe_load((DEPLOY / "k8s/kustomization.yaml").read_text(encoding="utf-8"))["resources"]
    assert sorted([*named, "kustomization.yaml"]) == sorted(path.name for path in (DEPLOY / "k8s").iterdir())


def test_the_server_is_authenticated_and_answers_to_its_own_names_only() -> None:
    (pod,) = (pod for name, pod in PODS.items() if name == "server")
    (container,) = pod["spec"]["containers"]
    cluster = {entry["name"]: entry.get("value", entry.get("valueFrom")) for entry in container["env"]}
    for environment in (SERVICES["server"]["environment"], cluster):
        assert environment["PREFECT_SERVER_API_AUTH_STRING"]
        assert environment["PREFECT_SERVER_CSRF_PROTECTION_ENABLED"] == "true"
        assert environment["PREFECT_SERVER_CORS_ALLOWED_ORIGINS"] == "http://127.0.0.1:4200"
        assert "server" in environment["DG4D_SERVER_HOSTS"].split(",") and "*" not in environment["DG4D_SERVER_HOSTS"]
    for probe in ("startupProbe", "readinessProbe", "livenessProbe"):  # a cluster asks by the address of the pod
        assert container[probe]["httpGet"]["httpHeaders"] == [{"name": "Host", "value": "localhost"}]
