# `make run` runs the main job, `make test` checks everything. Each sets up what it needs first.
# Arguments of `trilane run` go in ARGS: make run ARGS="--frames 60 --size 192"
SHELL := /bin/bash
.DELETE_ON_ERROR:
.PHONY: run test setup format compile interpreted clean

BIN := .venv/bin
COMPILED := $(shell sed -n 's/^    "\(.*\.py\)",$$/\1/p' scheduler/compiled.py)

run: .venv/ready-run
	$(BIN)/trilane run $(ARGS)

test: .venv/ready-test .venv/ready-core
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/pytest $(ARGS)

setup: .venv/ready-run

format: .venv/ready-test
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The scheduler's core in C, where there is a C compiler; and back, to edit it without compiling each time.
compile: .venv/ready-test
	$(BIN)/python setup.py --quiet build_ext --inplace
	touch .venv/ready-core .venv/ready-run

interpreted:
	rm -f src/*.so src/trilane/*/*.so

# The stamps are newer than what they depend on once the set-up is complete, so a second `make` starts at once.
.venv/ready-run: scripts/setup.sh pyproject.toml setup.py $(COMPILED)
	scripts/setup.sh openvino
	touch $@

.venv/ready-test: scripts/setup.sh pyproject.toml setup.py
	scripts/setup.sh openvino,metrics,dev
	touch $@ .venv/ready-core .venv/ready-run

.venv/ready-core: $(COMPILED) | .venv/ready-test
	$(MAKE) compile

clean:
	rm -rf .venv build dist src/*.so src/trilane/*/*.so
