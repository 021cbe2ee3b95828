"""Network policies of deploy/k8s/network.yaml: reachable is what the design names, and nothing else."""

import ipaddress
import itertools
from pathlib import Path
from typing import Any

import pytest
import rendering
import yaml

from flows.serving.pools import read_pools

K8S = Path(__file__).parents[2] / "deploy" / "k8s"
DOCUMENTS: list[dict[str, Any]] = [
    document
    for file in sorted(K8S.glob("*.yaml"))
    if file.name != "kustomization.yaml"
    for document in yaml.safe_load_all(file.read_text(encoding="utf-8"))
]
POLICIES = [document["spec"] for document in DOCUMENTS if document["kind"] == "NetworkPolicy"]
PODS: dict[str, dict[str, str]] = {
    document["metadata"]["name"]: document["spec"]["template"]["metadata"]["labels"]
    for document in DOCUMENTS
    if "template" in document.get("spec", {})
}
RUNS = {
    f"run of {pool.description}": rendering.job(pool)["spec"]["template"]["metadata"]["labels"]
    for pool in read_pools().values()
    if pool.type == "kubernetes"
}
EVERY = PODS | RUNS
CLIENTS = {"register", "worker-cpu", "worker-gpu", *RUNS}
PRIVATE = ("127.0.0.1", "10.1.2.3", "172.20.0.1", "192.168.1.1", "169.254.169.254", "100.100.100.200")
PRIVATE += ("::1", "fe80::1", "fd00:ec2::254", "64:ff9b::a00:1")
PORTS = {22, 53, 80, 443, 4200, 5432, 6379, 6443, 8080, 9000}

Pod = dict[str, str]


def selects(selector: dict[str, Any], labels: Pod) -> bool:
    """Match a label selector with a pod; an empty one fits all."""
    assert set(selector) <= {"matchLabels", "matchExpressions"}
    for expression in selector.get("matchExpressions", []):
        assert expression["operator"] == "In"
        if labels.get(expression["key"]) not in expression["values"]:
            return False
    return selector.get("matchLabels", {}).items() <= labels.items()


def fits(peer: dict[str, Any], other: Pod | str) -> bool:
    """Tell if a peer of a rule is a pod of the namespace, or an address outside of it."""
    if "ipBlock" in peer:
        if not isinstance(other, str):
            return False
        address, block = ipaddress.ip_address(other), peer["ipBlock"]
        inside = address in ipaddress.ip_network(block["cidr"])
        return inside and not any(address in ipaddress.ip_network(left_out) for left_out in block.get("except", []))
    if "namespaceSelector" in peer:
        return False  # another namespace
    return not isinstance(other, str) and selects(peer["podSelector"], other)


def opens(direction: str, pod: Pod, other: Pod | str, port: int) -> bool:
    """Tell if the policies of a pod let traffic of a direction through."""
    kind, peers = {"in": ("ingress", "from"), "out": ("egress", "to")}[direction]
    mine = [policy for policy in POLICIES if selects(policy["podSelector"], pod)]
    if not any(kind.capitalize() in policy["policyTypes"] for policy in mine):
        return True  # nothing restricts this pod
    return any(
        (peers not in rule or any(fits(peer, other) for peer in rule[peers]))
        and ("ports" not in rule or any(port == one["port"] for one in rule["ports"]))
        for policy in mine
        for rule in policy.get(kind, [])
    )


def reachable(source: str, target: str) -> set[int]:
    """The ports of a pod that another one reaches: both sides have to agree."""
    a, b = EVERY[source], EVERY[target]
    return {port for port in PORTS if opens("out", a, b, port) and opens("in", b, a, port)}


@pytest.mark.parametrize("kind", ["Ingress", "Egress"])
@pytest.mark.parametrize("name", EVERY)
def test_every_pod_is_closed_by_default(name: str, kind: str) -> None:
    chosen = [policy for policy in POLICIES if selects(policy["podSelector"], EVERY[name])]
    assert any(kind in policy["policyTypes"] for policy in chosen)


def test_pods_reach_what_they_need_and_nothing_else() -> None:
    assert len(RUNS) == 2 and {"server", "database", "redis", "s3"} <= set(PODS)
    wanted = {(client, "server"): {4200} for client in CLIENTS}
    wanted |= {("server", "database"): {5432}, ("server", "redis"): {6379}, ("server", "s3"): {9000}}
    wanted |= {(run, "s3"): {9000} for run in RUNS}
    found = {pair: reachable(*pair) for pair in itertools.permutations(EVERY, 2)}
    assert {pair: ports for pair, ports in found.items() if ports} == wanted


@pytest.mark.parametrize("outside", ["10.0.0.7", "203.0.113.7", "2001:db8::7"])
@pytest.mark.parametrize("name", EVERY)
def test_nothing_outside_of_the_namespace_reaches_a_pod(name: str, outside: str) -> None:
    assert not [port for port in PORTS if opens("in", EVERY[name], outside, port)]


@pytest.mark.parametrize("name", EVERY)
def test_only_runs_reach_the_internet_and_only_workers_the_cluster(name: str) -> None:
    public = {port for port in PORTS if opens("out", EVERY[name], "203.0.113.7", port)}
    assert public == ({80, 443} if name in RUNS else {443, 6443} if name.startswith("worker-") else set())


@pytest.mark.parametrize("address", PRIVATE)
@pytest.mark.parametrize("name", RUNS)
def test_a_run_reaches_no_private_or_link_local_address(name: str, address: str) -> None:
    assert not [port for port in PORTS if opens("out", EVERY[name], address, port)]


@pytest.mark.parametrize("name", EVERY)
def test_every_pod_can_ask_for_names(name: str) -> None:
    names = {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": "kube-system"}}}
    rules = [
        rule for policy in POLICIES if selects(policy["podSelector"], EVERY[name]) for rule in policy.get("egress", [])
    ]
    ports = [rule["ports"] for rule in rules if names in rule.get("to", [])]
    assert ports == [[{"port": 53, "protocol": "UDP"}, {"port": 53, "protocol": "TCP"}]]
