# `make run` runs the main job, `make test` checks everything. Each sets up what it needs first.
# Arguments of `trilane run` go in ARGS: make run ARGS="--frames 60 --size 192"
SHELL := /bin/bash
.DELETE_ON_ERROR:
.PHONY: run test test-all test-rest explore test-machines test-device results readme docs setup format clean

BIN := .venv/bin

# Images of containers often set it: each process of a test, thousands in all, would compile every file once more.
unexport PYTHONDONTWRITEBYTECODE

# Every check, whatever fails; with ARGS only the tests that it names, as pytest takes them.
checks = $(if $(ARGS),$(BIN)/pytest $(filter --slow,$(1)) $(ARGS),$(BIN)/python tests/support/checks.py $(1))

run: .venv/ready-run
	$(BIN)/trilane run $(ARGS)

test: .venv/ready-test
	@$(call checks)

# All that a machine without a GPU can run: every extra is installed, and a skip that is not on the list fails.
test-all: .venv/ready-all
	@$(call checks,--slow)

# What the last `make test` left out: slow tests, and those that it skipped for want of an extra.
test-rest: .venv/ready-all
	@$(call checks,--rest)

# Some tests once more on each machine of tests/machines.toml: one core, another locale and more.
# ARGS=--environments: those with packages or a Python of their own, which are installed once.
test-machines: .venv/ready-test
	@$(BIN)/python tests/support/machines.py $(ARGS)

# The property tests with examples that no run before has drawn; what fails prints how to repeat it.
explore: .venv/ready-test
	TRILANE_EXPLORE=1 $(BIN)/pytest --numprocesses auto -m hypothesis tests $(ARGS)

# What needs a GPU: hardware OpenGL, training on CUDA, the runtime cuda. Exit code 3 where there is none.
test-device: .venv/ready-device
	$(BIN)/pytest tests/device $(ARGS)
	$(BIN)/pytest tests/golden $(ARGS)
	$(BIN)/pytest tests/conformance/test_runtimes.py tests/conformance/test_hard_cases.py --runtime cuda $(ARGS)

# The project's own figures. docs/results: a sweep of this machine, some minutes in which it should do nothing else. Tables and pictures of
# docs/predict.md: computed from data beside this repository, where they are.
results: .venv/ready-all
	rm -rf sweeps/results
	$(BIN)/trilane sweep docs/results/runs.toml --out sweeps/results
	$(BIN)/trilane report sweeps/results --title "What a speed costs in image error" --out docs/results/report.html \
	  --csv docs/results/report.csv
	if [ -d ../shared/data/chips ]; then \
	  $(BIN)/trilane profiles fit-chips ../shared/data/chips --table docs/predict.md --plot docs/images/chip-errors.png; fi

# The figures and outputs in README.md, from a run, predictions and committed results; the picture of the dashboard too.
# Some minutes in which the machine should do nothing else. A test holds that they are as written.
readme: .venv/ready-all
	PYTHONPATH=tests $(BIN)/python tests/support/readme.py --measured

# The documents as a site, in site/; `make test` checks its links.
docs: .venv/ready-test
	$(BIN)/mkdocs build --strict

setup: .venv/ready-run

format: .venv/ready-test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The stamps are newer than what they depend on once the set-up is complete, so a second `make` starts at once.
.venv/ready-run: scripts/setup.sh pyproject.toml
	scripts/setup.sh openvino
	touch $@

.venv/ready-test: scripts/setup.sh pyproject.toml
	scripts/setup.sh openvino,metrics,dev
	touch $@ .venv/ready-run

.venv/ready-all: scripts/setup.sh scripts/tested-versions.txt pyproject.toml
	PIP_CONSTRAINT=scripts/tested-versions.txt scripts/setup.sh all,dev
	touch $@ .venv/ready-test .venv/ready-run

.venv/ready-device: scripts/setup.sh pyproject.toml
	nvidia-smi >/dev/null || { echo "make test-device: no GPU of NVIDIA here (nvidia-smi finds none)"; exit 3; }
	scripts/setup.sh train,dev
	$(BIN)/python -m pip uninstall --quiet --yes onnxruntime
	$(BIN)/python -m pip install --quiet onnxruntime-gpu
	touch $@

clean:
	rm -rf .venv build dist site
