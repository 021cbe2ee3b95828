# Two commands: `make demo` and `make test`. Both set the project up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
ARITHMETIC ?= fast
EMULATION := $(BIN)/python -m tests.emulation.build --arithmetic $(ARITHMETIC)
GPU_TESTS := $(BIN)/python -m pytest -p tests.emulation.plugin --arithmetic $(ARITHMETIC) -m gpu

TOOLS := out/tools
SHAPE_PRIOR ?=
UPGRADE ?=

.PHONY: setup clients demo test check audit lock emulation examples shape-prior clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml deploy/setup.sh deploy/install.sh $(wildcard deploy/locks/*.txt)
	PYTHON="$(PYTHON)" VENV="$(VENV)" TORCH_INDEX="$(TORCH_INDEX)" bash deploy/setup.sh
	touch $@

demo: setup
	$(BIN)/dg4d make examples/newt.png -o out/demo

# other people's readers of our files, for tests; without node or Chromium those tests are skipped, with the reason
clients: setup
	bash deploy/clients.sh

# weaknesses become known without a change of ours: they are told, and hold nothing back
test: setup clients check
	-$(MAKE) --no-print-directory audit
	$(BIN)/python -m pytest -n 2 --dist loadscope --jaxtyping-packages=dg4d_lib,beartype.beartype\(conf=beartype.BeartypeConf\(is_pep484_tower=True\)\)

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

$(TOOLS)/.ready: deploy/locks/tools.txt deploy/install.sh
	$(PYTHON) -m venv $(TOOLS) && VENV=$(TOOLS) timeout 300 bash deploy/install.sh tools
	touch $@

# torch.txt names a build that the package index does not know; cuda.txt has the same version
audit: setup $(TOOLS)/.ready
	timeout 300 $(TOOLS)/bin/pip-audit $(foreach lock,steps flows cuda dev meshopt tools,-r deploy/locks/$(lock).txt) \
		--no-deps --disable-pip -f json --progress-spinner off | $(BIN)/python deploy/audit.py

# Resolve pyproject.toml into deploy/locks. Versions stay unless UPGRADE="--upgrade" or "--upgrade-package NAME".
lock: $(TOOLS)/.ready
	TORCH_INDEX="$(TORCH_INDEX)" $(TOOLS)/bin/python deploy/lock.py $(UPGRADE)

# the tests marked gpu on an emulated one, with gsplat's own kernels; ARITHMETIC=noise rounds as badly as CUDA may
emulation: setup
	$(EMULATION)
	$(GPU_TESTS)

examples: setup
	$(BIN)/python -m examples.make_examples

# train the network of `prior.kind=learned`; run it again to resume, SHAPE_PRIOR="--samples 800000" trains longer
shape-prior: setup
	$(BIN)/python -m training.shape_prior.train out/shape_prior $(SHAPE_PRIOR)

clean:
	rm -rf $(VENV) out
