"""deploy/compose.yaml and deploy/k8s: valid by their schemas, confined, and without a secret in them."""

import os
import re
import subprocess
from pathlib import Path
from typing import Any

import kubernetes_validate
import pytest
import yaml
from compose_spec import PyCompose
from yamllint import linter
from yamllint.config import YamlLintConfig

from flows.serving.server import LOGIN

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
SECRET = re.compile(r"PASSWORD|SECRET|AUTH|KEY")  # in the name of a variable
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


def test_only_workers_which_fetch_sources_and_weights_and_the_server_reach_the_internet() -> None:
    assert COMPOSE["networks"] == {"inside": {"internal": True}, "outside": {}}
    reach = {name for name, service in SERVICES.items() if service.get("networks", []) != ["inside"]} - {"volumes"}
    assert reach == {"server", "worker-cpu", "worker-gpu"}


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


def test_every_foreign_image_is_pinned_by_digest_and_its_version_is_told() -> None:
    text = "\n".join(file.read_text(encoding="utf-8") for file in FILES)
    images = re.findall(r"^( *#.*\n)? *image: (\S+)$", text, re.MULTILINE)
    foreign = {(comment.strip(), image) for comment, image in images if not image.startswith("dg4d/")}
    assert len(foreign) == 3 < len(images)  # the same in both places
    for comment, image in foreign:
        name, _, digest = image.partition("@")
        assert re.fullmatch(r"sha256:[0-9a-f]{64}", digest)
        assert re.fullmatch(rf"# {re.escape(name)}:[\w.-]*\d[\w.-]*", comment)


@pytest.mark.parametrize("file", ["deploy/compose.yaml", "deploy/k8s/kustomization.yaml", "docs/deployment.md"])
def test_the_address_that_signs_in_and_its_secret_are_told(file: str) -> None:
    text = (DEPLOY.parent / file).read_text(encoding="utf-8")
    assert f"http://127.0.0.1:4200{LOGIN}#NAME:PASSWORD" in text
    assert "DG4D_API_AUTH" in text or "PREFECT_API_AUTH_STRING" in text


def test_an_image_of_ours_that_is_there_is_not_pulled() -> None:
    containers = [container for pod in PODS.values() for container in pod["spec"]["containers"]]
    ours = [container for container in containers if container["image"].startswith("dg4d/")]
    assert len(ours) == 4 and all(container["imagePullPolicy"] == "IfNotPresent" for container in ours)
    services = [service for service in SERVICES.values() if service["image"].startswith("dg4d/")]
    assert len(services) == 5 and all(service["pull_policy"] == "never" for service in services)


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


@pytest.mark.parametrize("name", ["worker-cpu", "worker-gpu"])
def test_a_worker_makes_its_temporary_folder_on_a_disk(name: str, tmp_path: Path) -> None:
    worker = SERVICES[name]
    assert worker["environment"]["TMPDIR"].startswith("/data/")
    assert worker["command"][:2] == ["sh", "-c"]
    (tmp_path / "prefect").write_text('#!/bin/sh\necho "$@"')
    (tmp_path / "prefect").chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "TMPDIR": str(tmp_path / "deep" / "tmp")}
    script = worker["command"][2].replace("$$", "$")
    done = subprocess.run(["sh", "-c", script], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == f"worker start --pool {name.replace('worker', 'process')} --with-healthcheck\n"
    assert (tmp_path / "deep" / "tmp").is_dir()


def redis_script(place: str) -> str:
    """The shell script that starts Redis, as a shell gets it."""
    if place == "compose":
        assert SERVICES["redis"]["entrypoint"] == ["sh", "-c"]
        (script,) = SERVICES["redis"]["command"]
        return str(script).replace("$$", "$")
    (container,) = PODS["redis"]["spec"]["containers"]
    assert container["command"][:2] == ["sh", "-c"]
    return str(container["command"][2])


def start_redis(place: str, folder: Path, password: str) -> subprocess.CompletedProcess[str]:
    """Run the script with a program in the place of Redis that writes down its arguments and its input."""
    stand_in = folder / "redis-server"
    stand_in.write_text(f'#!/bin/sh\necho "$@" > {folder}/arguments\ncat > {folder}/input\n')
    stand_in.chmod(0o755)
    environment = {"PATH": f"{folder}:{os.environ['PATH']}", "REDISCLI_AUTH": password}
    command = ["sh", "-c", redis_script(place)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("place", ["compose", "kubernetes"])
def test_redis_gets_its_password_where_no_list_of_processes_shows_it(place: str, tmp_path: Path) -> None:
    assert start_redis(place, tmp_path, "se cret").returncode == 0
    arguments = (tmp_path / "arguments").read_text().split()
    assert (tmp_path / "input").read_text() == 'requirepass "se cret"\n'
    assert arguments[0] == "-" and "cret" not in " ".join(arguments)  # `-`: settings from standard input
    assert arguments[arguments.index("--protected-mode") + 1] == "no"  # answers other machines, by password


@pytest.mark.parametrize("place", ["compose", "kubernetes"])
def test_redis_does_not_start_without_a_password(place: str, tmp_path: Path) -> None:
    done = start_redis(place, tmp_path, "")
    assert done.returncode != 0 and "a password for Redis is missing" in done.stderr
    assert not (tmp_path / "input").exists()


def test_redis_is_healthy_only_for_those_who_know_its_password() -> None:
    (container,) = PODS["redis"]["spec"]["containers"]
    checks = [container[name]["exec"]["command"] for name in ("readinessProbe", "livenessProbe")]
    checks.append(SERVICES["redis"]["healthcheck"]["test"][1:])
    assert all(check == ["redis-cli", "-e", "ping"] for check in checks)  # -e: an error is an exit status
    assert "REDISCLI_AUTH" in SERVICES["redis"]["environment"]  # which redis-cli reads


def test_the_server_knows_the_password_of_redis_and_no_run_does() -> None:
    name = "PREFECT_REDIS_MESSAGING_PASSWORD"
    assert SERVICES["server"]["environment"][name] == SERVICES["redis"]["environment"]["REDISCLI_AUTH"]
    (server,), (redis,) = PODS["server"]["spec"]["containers"], PODS["redis"]["spec"]["containers"]
    secrets = {variable["name"]: variable.get("valueFrom") for variable in (*server["env"], *redis["env"])}
    assert secrets[name] == secrets["REDISCLI_AUTH"] == {"secretKeyRef": {"name": "dg4d-redis", "key": "password"}}
    others = {file: service for file, service in SERVICES.items() if file not in {"server", "redis"}}
    assert not [file for file, service in others.items() if name in service.get("environment", {})]


def test_the_password_of_redis_has_the_name_that_prefect_reads(monkeypatch: pytest.MonkeyPatch) -> None:
    client = pytest.importorskip("prefect_redis.client", reason="prefect-redis is not installed: make setup")
    monkeypatch.setenv("PREFECT_REDIS_MESSAGING_PASSWORD", "se cret")
    assert client.RedisMessagingSettings().password == "se cret"


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
