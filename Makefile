# `make run` runs the main job, `make test` checks everything. Each sets up what it needs first.
# Arguments of `trilane run` go in ARGS: make run ARGS="--frames 60 --size 192"
SHELL := /bin/bash
.DELETE_ON_ERROR:
.PHONY: run test setup format clean

BIN := .venv/bin

run: .venv/ready-run
	$(BIN)/trilane run $(ARGS)

test: .venv/ready-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest $(ARGS)

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

clean:
	rm -rf .venv build dist
