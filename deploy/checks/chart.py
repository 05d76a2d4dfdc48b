"""``python -m deploy.checks.chart``: renders the chart with Helm and writes the manifests that are committed.

The engine is Helm's own, as a library (Helm 4); Kubernetes' schemas come with kubernetes-validate, those of the
Prometheus operator with its models.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import helm_python
import kubernetes_validate
import yaml
from cloudcoil.models.prometheus_operator import v1 as prometheus_operator

DEPLOY = Path(__file__).parent.parent
CHART = DEPLOY / "helm/unbend"
VALUES = DEPLOY / "helm/values"
MANIFESTS = DEPLOY / "kubernetes"
#: The oldest that the chart names, and the newest that is known.
KUBERNETES = ("1.27", "1.37")

Manifest = dict[str, Any]


def value_sets() -> list[str]:
    """The names of the sets of values that are rendered."""
    return sorted(path.stem for path in VALUES.glob("*.yaml"))


def values_of(name: str) -> dict[str, Any]:
    """One set of values, as Helm reads it."""
    values: dict[str, Any] = helm_python.values_from_yaml((VALUES / f"{name}.yaml").read_text())
    return values


def render(values: dict[str, Any]) -> list[Manifest]:
    """What `helm template unbend deploy/helm/unbend --namespace unbend` gives, in the order of the files.

    Raises:
        helm_python.HelmError: the values do not fit the schema of the chart, or a template fails.
    """
    with helm_python.Chart.load(CHART) as chart:
        chart.validate_schema(values)
        texts = chart.render(values, name="unbend", namespace="unbend")
    manifests = [yaml.safe_load_all(texts[path]) for path in sorted(texts) if path.endswith(".yaml")]
    return [manifest for documents in manifests for manifest in documents if manifest]


def check(manifest: Manifest) -> None:
    """Holds one manifest against the schema of its kind, strictly: a field that is not known is an error.

    Raises:
        kubernetes_validate.ValidationError, pydantic.ValidationError: it is not what the API server takes.
    """
    if manifest["apiVersion"].startswith("monitoring.coreos.com/"):
        getattr(prometheus_operator, manifest["kind"]).model_validate(manifest, strict=False, extra="forbid")
        return
    for version in KUBERNETES:
        kubernetes_validate.validate(manifest, version, strict=True)


def written(name: str) -> str:
    """The text of the committed manifests of one set of values."""
    head = f"# Rendered from deploy/helm/unbend with deploy/helm/values/{name}.yaml: make manifests\n"
    return head + yaml.safe_dump_all(render(values_of(name)), sort_keys=False, width=120)


def main() -> int:
    """Renders, checks and writes every set of values."""
    for name in value_sets():
        for manifest in render(values_of(name)):
            check(manifest)
            print(f"ok  {name}: {manifest['kind']} {manifest['metadata']['name']}")
        (MANIFESTS / f"{name}.yaml").write_text(written(name))
    return 0


if __name__ == "__main__":
    sys.exit(main())
