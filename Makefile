# `make demo` and `make test` set the project up first. `make setup CUDA=1` installs for an NVIDIA GPU.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# CUDA=1 installs torch for CUDA, gsplat and the diffusion models. An environment keeps its build; CUDA=0 returns to the CPU.
CUDA ?= $(if $(wildcard $(VENV)/.ready-cuda),1,0)
READY := $(VENV)/.ready$(if $(filter 1,$(CUDA)),-cuda)
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
ARITHMETIC ?= fast
EMULATION := $(BIN)/python -m tests.emulation.build --arithmetic $(ARITHMETIC)
# three workers for two cores: many tests wait for servers and browsers
TESTS := $(BIN)/python -m pytest -n 3 --dist loadscope \
	--jaxtyping-packages=dg4d_lib,beartype.beartype\(conf=beartype.BeartypeConf\(is_pep484_tower=True\)\)
GPU_TESTS := $(BIN)/python -m pytest -p tests.emulation.plugin --arithmetic $(ARITHMETIC) -m gpu

unexport PYTHONDONTWRITEBYTECODE  # the hundreds of processes of the tests would compile our modules again and again

TOOLS := out/tools
AUDIT := timeout 300 $(TOOLS)/bin/pip-audit --no-deps --disable-pip -f json --progress-spinner off
DOCS := out/docs
SHAPE_PRIOR ?=
UPGRADE ?=
NAMES ?=

.PHONY: setup clients demo test tests nightly check audit audit-report lock docs emulation examples gallery shape-prior clean

setup: $(READY)

# The other build's file is removed first: after a failed switch the environment must not count as complete. The build's
# own file is out of date here and stays: after a failed update `make setup` tries the same build again.
$(READY): pyproject.toml deploy/setup.sh deploy/install.sh $(wildcard deploy/locks/*.txt)
	rm -f $(filter-out $@,$(VENV)/.ready $(VENV)/.ready-cuda)
	PYTHON="$(PYTHON)" VENV="$(VENV)" TORCH_INDEX="$(TORCH_INDEX)" CUDA="$(CUDA)" bash deploy/setup.sh
	touch $@

demo: setup
	$(BIN)/dg4d make examples/newt.png -o out/demo

# Third-party readers of our files, for tests. Without Node.js or Chromium these tests are skipped with the reason.
clients: setup
	bash deploy/clients.sh

# The checks and the audit run beside the tests, which often wait for servers.
test: setup clients
	$(MAKE) --no-print-directory --jobs=3 check audit-report tests

tests:
	$(TESTS) -m "not slow"

# Audit findings are reported but do not fail the build: they appear without a change of ours.
audit-report:
	-$(MAKE) --no-print-directory audit

# the tests marked slow (several machines, crashing databases, the fuzzer, full-size profiles), and the emulated GPU
nightly: setup clients emulation
	$(TESTS) -m slow

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache
	$(BIN)/python -m pytest -q -n 0 tests/architecture/test_readme.py

$(TOOLS)/.ready: deploy/locks/tools.txt deploy/install.sh
	$(PYTHON) -m venv $(TOOLS) && VENV=$(TOOLS) timeout 300 bash deploy/install.sh tools
	touch $@

# torch.txt names a build that the package index does not know; cuda.txt has the same version. docs.txt is audited by
# itself: pip-audit refuses two versions of a package in one call.
audit: setup $(TOOLS)/.ready
	$(AUDIT) $(foreach lock,steps flows cuda dev meshopt tools,-r deploy/locks/$(lock).txt) > out/audit.json; \
	$(AUDIT) -r deploy/locks/docs.txt > out/audit-docs.json; \
	$(BIN)/python deploy/audit.py out/audit.json out/audit-docs.json

# Resolve pyproject.toml into deploy/locks. Versions stay unless UPGRADE="--upgrade" or "--upgrade-package NAME".
lock: $(TOOLS)/.ready
	TORCH_INDEX="$(TORCH_INDEX)" $(TOOLS)/bin/python deploy/lock.py $(UPGRADE)

$(DOCS)/.ready: deploy/locks/docs.txt deploy/install.sh
	$(PYTHON) -m venv $(DOCS) && VENV=$(DOCS) timeout 600 bash deploy/install.sh docs
	touch $@

# Write the pages that come from the program, then the site into out/site. Warnings and broken links are errors.
docs: setup $(DOCS)/.ready
	$(BIN)/python docs/generate.py
	$(BIN)/python docs/assemble.py out/pages
	NO_MKDOCS_2_WARNING=1 $(DOCS)/bin/mkdocs build --strict --config-file docs/mkdocs.yml

# the tests marked gpu on an emulated one, with gsplat's own kernels; ARITHMETIC=noise rounds as badly as CUDA may
emulation: setup
	$(EMULATION)
	$(GPU_TESTS)

examples: setup
	$(BIN)/python -m examples.make_examples

# draw and convert the ten pictures of docs/gallery.md, about 20 minutes; NAMES="fish car" chooses
gallery: setup
	$(BIN)/python -m examples.gallery.make_gallery $(NAMES)

# train the network of `prior.kind=learned`; run it again to resume, SHAPE_PRIOR="--samples 800000" trains longer
shape-prior: setup
	$(BIN)/python -m training.shape_prior.train out/shape_prior $(SHAPE_PRIOR)

clean:
	rm -rf $(VENV) out
