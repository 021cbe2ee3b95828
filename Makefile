# Two commands: `make demo` and `make test`. Both set the project up first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
ARITHMETIC ?= fast
EMULATION := $(BIN)/python -m tests.emulation.build --arithmetic $(ARITHMETIC)
GPU_TESTS := $(BIN)/python -m pytest -p tests.emulation.plugin --arithmetic $(ARITHMETIC) -m gpu

.PHONY: setup clients demo test check audit emulation examples clean

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml constraints.txt deploy/setup.sh
	PYTHON="$(PYTHON)" VENV="$(VENV)" TORCH_INDEX="$(TORCH_INDEX)" bash deploy/setup.sh
	touch $@

demo: setup
	$(BIN)/dg4d make examples/newt.png -o out/demo

# other people's readers of our files, for tests; without node or Chromium those tests are skipped, with the reason
clients: setup
	bash deploy/clients.sh

# weaknesses become known without a change of ours: they are told, and hold nothing back; 69: g++ or the network is missing
test: setup clients check
	-$(MAKE) --no-print-directory audit
	$(BIN)/python -m pytest -n 2 --dist loadscope --jaxtyping-packages=dg4d_lib,beartype.beartype\(conf=beartype.BeartypeConf\(is_pep484_tower=True\)\)
	$(EMULATION); case $$? in 0) $(GPU_TESTS);; 69) ;; *) exit 1;; esac

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

out/audit/bin/pip-audit: $(VENV)/.ready
	$(BIN)/python -m venv out/audit && timeout 300 out/audit/bin/pip install -q pip-audit
	touch $@

audit: setup out/audit/bin/pip-audit
	timeout 300 out/audit/bin/pip-audit -r constraints.txt --no-deps --disable-pip -f json --progress-spinner off | $(BIN)/python deploy/audit.py

# the tests marked gpu on an emulated one, with gsplat's own kernels; ARITHMETIC=noise rounds as badly as CUDA may
emulation: setup
	$(EMULATION)
	$(GPU_TESTS)

examples: setup
	$(BIN)/python -m examples.make_examples

clean:
	rm -rf $(VENV) out
