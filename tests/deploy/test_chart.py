"""The Helm chart, rendered by Helm's own engine for each set of values that is offered."""

from __future__ import annotations

import re
from typing import Any

import pytest

from unbend_service.settings import Settings

pytestmark = pytest.mark.deploy

chart = pytest.importorskip("deploy.checks.chart", reason="the dependency group deploy is not installed")
helm = pytest.importorskip("helm_python")

Manifest = dict[str, Any]
SETS = ("cpu", "gpu", "split")


def of_kind(manifests: list[Manifest], kind: str) -> dict[str, Manifest]:
    return {manifest["metadata"]["name"]: manifest for manifest in manifests if manifest["kind"] == kind}


@pytest.fixture(scope="module", params=SETS)
def values(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def manifests(values: str) -> list[Manifest]:
    return list(chart.render(chart.values_of(values)))


def pods(manifests: list[Manifest]) -> list[Manifest]:
    return [each["spec"]["template"] for each in of_kind(manifests, "Deployment").values()]


def container(pod: Manifest) -> Manifest:
    (only,) = pod["spec"]["containers"]
    return dict(only)


def environment(pod: Manifest) -> dict[str, str]:
    return {entry["name"]: entry["value"] for entry in container(pod)["env"] if "value" in entry}


def mebibytes(quantity: str) -> int:
    match = re.fullmatch(r"(\d+)Mi", quantity)
    assert match
    return int(match[1])


def test_there_are_values_for_cpu_gpu_and_split() -> None:
    assert tuple(chart.value_sets()) == SETS


def test_helm_finds_nothing_to_complain_about(values: str) -> None:
    report = helm.lint(chart.CHART, chart.values_of(values), strict=True)
    assert not report["errors"]
    assert [finding for finding in report["messages"] if finding["severity"] > 1] == []


def test_the_api_server_would_take_every_manifest(manifests: list[Manifest]) -> None:
    for manifest in manifests:
        chart.check(manifest)


def test_a_field_that_kubernetes_does_not_know_is_found(manifests: list[Manifest]) -> None:
    for manifest in manifests:
        if manifest["kind"] in ("Deployment", "ServiceMonitor"):
            wrong = {**manifest, "spec": {**manifest["spec"], "replica": 2}}
            with pytest.raises(Exception, match="replica"):
                chart.check(wrong)


def test_the_committed_manifests_are_those_of_the_chart(values: str) -> None:
    assert (chart.MANIFESTS / f"{values}.yaml").read_text() == chart.written(values), "run `make manifests`"


def test_pods_meet_the_restricted_security_standard(manifests: list[Manifest]) -> None:
    for pod in pods(manifests):
        assert pod["spec"]["securityContext"]["runAsNonRoot"] is True
        assert pod["spec"]["securityContext"]["seccompProfile"] == {"type": "RuntimeDefault"}
        assert pod["spec"]["automountServiceAccountToken"] is False
        assert not {"hostNetwork", "hostPID", "hostIPC"} & pod["spec"].keys()
        security = container(pod)["securityContext"]
        assert security["allowPrivilegeEscalation"] is False
        assert security["readOnlyRootFilesystem"] is True
        assert security["capabilities"] == {"drop": ["ALL"]}
        assert all({"emptyDir", "secret", "configMap"} & volume.keys() for volume in pod["spec"]["volumes"])


def test_a_pod_is_given_longer_than_its_pause_and_its_drain(manifests: list[Manifest]) -> None:
    for pod in pods(manifests):
        pause = int(container(pod)["lifecycle"]["preStop"]["exec"]["command"][1])
        drain = float(environment(pod)["UNBEND_DRAIN_S"]) + float(environment(pod)["UNBEND_DRAIN_NOTICE_S"])
        assert pause > 0
        assert pod["spec"]["terminationGracePeriodSeconds"] >= pause + drain + 5


def test_probes_ask_over_grpc_and_liveness_does_not_ask_for_readiness(manifests: list[Manifest]) -> None:
    for pod in pods(manifests):
        asked = {name: container(pod)[f"{name}Probe"]["grpc"] for name in ("startup", "readiness", "liveness")}
        assert asked["startup"] == asked["readiness"] == {"port": 50051, "service": ""}
        assert asked["liveness"] == {"port": 50051, "service": "live"}


def test_memory_that_is_a_file_system_is_part_of_the_limit(manifests: list[Manifest]) -> None:
    for pod in pods(manifests):
        limit = mebibytes(container(pod)["resources"]["limits"]["memory"])
        volumes = {volume["name"]: volume["emptyDir"] for volume in pod["spec"]["volumes"] if "emptyDir" in volume}
        assert {volume["medium"] for volume in volumes.values()} == {"Memory"}
        assert {mount["mountPath"] for mount in container(pod)["volumeMounts"]} >= {"/dev/shm", "/tmp"}
        files = sum(mebibytes(volume["sizeLimit"]) for volume in volumes.values())
        frames = int(environment(pod)["UNBEND_SHARED_MEMORY_BYTES"]) >> 20
        assert limit >= files + frames + 1024


def test_what_callers_can_make_it_hold_fits_into_the_memory_of_its_processes(manifests: list[Manifest]) -> None:
    for pod in pods(manifests):
        limit = mebibytes(container(pod)["resources"]["limits"]["memory"]) << 20
        given = {name: int(value) for name, value in environment(pod).items() if value.isdigit()}
        files = 2 * (64 << 20) + given["UNBEND_SHARED_MEMORY_BYTES"]
        pictures = sum(given[f"UNBEND_{what}_BYTES"] for what in ("PICTURES", "BODIES", "STREAM_FRAMES"))
        decoding = given["UNBEND_DECODERS"] * given["UNBEND_DECODE_MEMORY_BYTES"]
        assert decoding + pictures <= 3 * (limit - files) // 4
        assert given["UNBEND_DECODE_MEMORY_BYTES"] >= 512 << 20  # a photograph of 100 million pixels


@pytest.mark.parametrize(("asked", "cores"), [("2", 2), ("0.5", 1), ("2500m", 3)])
def test_a_pod_starts_as_many_processes_as_it_asks_for_cores_and_not_as_its_node_has(asked: str, cores: int) -> None:
    (pod,) = pods(chart.render({"components": {"all": {"cpu": asked}}}))
    for name in ("UNBEND_WORKERS", "UNBEND_DECODERS", "UNBEND_ESTIMATOR_THREADS"):
        assert environment(pod)[name] == str(cores)


def test_the_environment_names_settings_that_exist(manifests: list[Manifest]) -> None:
    known = {f"UNBEND_{name.upper()}" for name in Settings.model_fields}
    for pod in pods(manifests):
        assert {name for name in environment(pod) if name.startswith("UNBEND_")} <= known
        Settings(**{name.removeprefix("UNBEND_").lower(): value for name, value in environment(pod).items()})


def test_every_deployment_scales_by_itself_and_is_not_evicted_whole(manifests: list[Manifest]) -> None:
    deployments = of_kind(manifests, "Deployment")
    scalers, budgets = of_kind(manifests, "HorizontalPodAutoscaler"), of_kind(manifests, "PodDisruptionBudget")
    assert scalers.keys() == budgets.keys() == deployments.keys()
    for name, deployment in deployments.items():
        assert "replicas" not in deployment["spec"]  # the autoscaler's
        assert scalers[name]["spec"]["scaleTargetRef"]["name"] == name
        labels = deployment["spec"]["template"]["metadata"]["labels"]
        assert budgets[name]["spec"]["selector"]["matchLabels"].items() <= labels.items()
        kinds = {metric["type"] for metric in scalers[name]["spec"]["metrics"]}
        assert "Resource" in kinds
        if deployment["metadata"]["labels"]["app.kubernetes.io/component"] != "estimate":
            assert "Pods" in kinds


def test_services_select_the_replicas_that_clients_may_call(manifests: list[Manifest]) -> None:
    services = of_kind(manifests, "Service")
    assert services["unbend-grpc"]["spec"]["clusterIP"] == "None"
    for name in ("unbend", "unbend-grpc"):
        selector = services[name]["spec"]["selector"].items()
        fronts = [pod for pod in pods(manifests) if selector <= pod["metadata"]["labels"].items()]
        assert fronts
        assert all(environment(pod)["UNBEND_ROLE"] != "estimate" for pod in fronts)


def test_the_service_monitor_finds_a_port_of_a_service(manifests: list[Manifest]) -> None:
    (monitor,) = of_kind(manifests, "ServiceMonitor").values()
    wanted = monitor["spec"]["selector"]["matchLabels"].items()
    found = [each for each in of_kind(manifests, "Service").values() if wanted <= each["metadata"]["labels"].items()]
    assert len(found) == 1, "a replica that is found twice counts twice"
    ports = {port["name"] for port in found[0]["spec"]["ports"]}
    assert {endpoint["port"] for endpoint in monitor["spec"]["endpoints"]} <= ports
    assert all(found[0]["spec"]["selector"].items() <= pod["metadata"]["labels"].items() for pod in pods(manifests))


def test_a_gpu_is_asked_for_and_insisted_on_only_where_it_is_wanted() -> None:
    (cpu,), (gpu,) = (pods(chart.render(chart.values_of(name))) for name in ("cpu", "gpu"))
    assert "nvidia.com/gpu" not in container(cpu)["resources"]["limits"]
    assert "UNBEND_REQUIRE_GPU" not in environment(cpu)
    assert container(gpu)["resources"]["limits"]["nvidia.com/gpu"] == "1"
    assert environment(gpu)["UNBEND_REQUIRE_GPU"] == "true"


def test_split_render_nodes_ask_estimation_nodes_which_nobody_else_reaches() -> None:
    manifests = chart.render(chart.values_of("split"))
    by_role = {environment(pod)["UNBEND_ROLE"]: pod for pod in pods(manifests)}
    assert by_role.keys() == {"render", "estimate"}
    assert environment(by_role["render"])["UNBEND_ESTIMATOR_ADDRESS"] == "dns:///unbend-estimate:50051"
    service = of_kind(manifests, "Service")["unbend-estimate"]
    assert service["spec"]["selector"].items() <= by_role["estimate"]["metadata"]["labels"].items()
    (calls, _) = of_kind(manifests, "NetworkPolicy")["unbend-estimate"]["spec"]["ingress"]
    (caller,) = calls["from"]
    callers = caller["podSelector"]["matchLabels"].items()
    assert callers <= by_role["render"]["metadata"]["labels"].items()
    assert not callers <= by_role["estimate"]["metadata"]["labels"].items()


def test_with_tls_the_kubelet_asks_the_listener_for_health_because_it_cannot_ask_grpc() -> None:
    manifests = chart.render({"tls": {"existingSecret": "unbend-tls", "clientCa": True}})
    for manifest in manifests:
        chart.check(manifest)
    (pod,) = pods(manifests)
    for name, path in {"startup": "/readyz", "readiness": "/readyz", "liveness": "/livez"}.items():
        assert container(pod)[f"{name}Probe"]["httpGet"] == {"path": path, "port": "ops", "scheme": "HTTPS"}
    assert environment(pod)["UNBEND_TLS_CLIENT_CA"] == "/etc/unbend/tls/ca.crt"


def test_with_tls_prometheus_asks_each_component_in_the_way_it_speaks() -> None:
    values = chart.values_of("split") | {"tls": {"existingSecret": "unbend-tls"}}
    manifests = chart.render(values)
    (monitor,) = of_kind(manifests, "ServiceMonitor").values()
    chart.check(monitor)
    asked = {each["relabelings"][0]["regex"]: each["scheme"] for each in monitor["spec"]["endpoints"]}
    assert asked == {"true": "https", "false": "http"}
    for pod in pods(manifests):
        scheme = "https" if "UNBEND_TLS_CERT" in environment(pod) else "http"
        assert asked[pod["metadata"]["labels"]["unbend/front"]] == scheme


@pytest.mark.parametrize(
    "wrong",
    [
        {"replicaCount": 3},
        {"components": {"all": {"role": "draw"}}},
        {"env": {"UNBEND_STREAMS": 5}},
        {"redis": {"url": "x"}},
    ],
)
def test_values_that_the_chart_does_not_know_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(helm.HelmError):
        chart.render(wrong)
