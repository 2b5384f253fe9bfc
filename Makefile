# Two commands: `make demo` shows it, `make test` checks it. `make help` lists the rest.

PYTHON ?= $(firstword $(foreach p,python3 python3.14 python3.13 python3.12 python3.11,$(shell \
	$(p) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(p))))
BIN := .venv/bin
PIP := $(BIN)/python -m pip --quiet --quiet --disable-pip-version-check --no-input

# Bytecode is kept: hundreds of processes of the tests would compile every module again.
export PYTHONDONTWRITEBYTECODE :=

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo docs test quick coverage mutation test-system test-real-time test-beside test-native test-long test-lane test-containers simulate install uninstall lint format clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z.-]+:.*## / {printf "make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: .venv/demo.stamp  ## emulator, daemon, broker and page together; DURATION=15 ends by itself
	@exec $(BIN)/skin demo $(if $(DURATION),--duration $(DURATION))

# Real time on a shared computer: a test that fails is run once more, and the summary names it.
AGAIN := --reruns=1 -rR

# What comes in files stays in one process with its fixtures; the order is that of tests/conftest.py.
BY_FILE := --numprocesses=4 --dist=loadfile --no-loadscope-reorder

# In a fresh clone mypy takes as long as a fifth of the tests: it runs beside them.
test: .venv/dev.stamp  ## all that needs no root, no hardware and no broker, and takes no minutes
	@$(MAKE) --no-print-directory --jobs=2 lint quick

quick: .venv/dev.stamp
	@$(BIN)/python -m compileall -q skin_host emulator
	@tools/timed "pytest" $(BIN)/python -m pytest -m "not mosquitto and not long" $(BY_FILE) $(AGAIN)

coverage: .venv/dev.stamp .venv/coverage.stamp  ## statements and branches of the core that the tests run: 95 % of the branches at least
	@$(BIN)/python -m pytest --quiet $(BY_FILE) --cov --cov-report=term --cov-report=json:.coverage.json
	@$(BIN)/python -m tests.support.branches .coverage.json

mutation: .venv/dev.stamp .venv/mutation.stamp  ## small changes of the core that its tests must notice; FILES=... PLACES=40 SEED=1
	@$(BIN)/python -m tests.support.mutation --places $(or $(PLACES),40) --seed $(or $(SEED),1) $(FILES)

test-system: .venv/dev.stamp .venv/fuzz.stamp  ## real CAN, I2C, systemd, broker and browser; root, if packages are missing
	@tools/timed "packages" tools/lane/packages
	@$(BIN)/python -m compileall -q skin_host emulator tests
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target test-real-time test-beside

# What runs in real time, then containers; beside it what computes, which gives way to it, and a
# Debian: both take as long.
test-real-time: test-native
	@tools/timed "on this host: the other tests with a broker" \
		$(BIN)/python -m pytest tests -m mosquitto --hypothesis-profile=far \
		--require-mosquitto $(BY_FILE) $(AGAIN)
	@$(MAKE) --no-print-directory test-lane
	@$(MAKE) --no-print-directory test-containers

test-beside: test-long
	@tools/timed "a Debian that boots: its disk" tools/lane/debian
	@tools/timed "a Debian that boots: systemd and CAN cards" \
		$(BIN)/python -m pytest tests/system/systemd --numprocesses=2 --dist=loadfile $(AGAIN)

test-native: .venv/dev.stamp .venv/fuzz.stamp
	@tools/timed "on this host: broker, browser, the lane itself" \
		$(BIN)/python -m pytest tests/system/native --require-mosquitto \
		--numprocesses=2 --dist=loadfile --no-loadscope-reorder $(AGAIN)

test-long: .venv/dev.stamp
	@tools/timed "on this host: what computes for long" nice -n 19 \
		$(BIN)/python -m pytest tests -m "(long or hypothesis) and not mosquitto" \
		--hypothesis-profile=far --numprocesses=2 --dist=loadfile --no-loadscope-reorder $(AGAIN)

test-lane: .venv/dev.stamp
	@tools/timed "in the lane: vcan and CUSE" \
		tools/lane/run $(BIN)/python -m pytest tests/stack tests/system/lane \
		--bus=vcan --require-mosquitto -o faulthandler_timeout=300 $(AGAIN)

test-containers: .venv/dev.stamp
	@tools/timed "containers: the image is built, it and the compose file run" \
		tools/lane/image $(BIN)/python -m pytest tests/system/containers $(AGAIN)

docs: .venv/docs.stamp  ## a site from docs/ with an API reference, in site/; every link is checked
	@$(BIN)/mkdocs build --strict
	@echo "site/index.html"

simulate: .venv/dev.stamp  ## the whole system through faults, robot-hours by the seed: SEEDS=1000
	@$(BIN)/skin simulate --seeds $(or $(SEEDS),100) --hours 1

install:  ## the service on this machine, as root; DESTDIR stages it elsewhere
	@PYTHON="$(PYTHON)" systemd/install install

uninstall:  ## take the service away; configuration and calibrations stay
	@systemd/install uninstall

lint: .venv/dev.stamp  ## ruff and mypy
	@$(BIN)/ruff check --quiet .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy

format: .venv/dev.stamp  ## ruff, rewriting
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

clean:  ## the virtual environment, the lane's machine and caches
	rm -rf .venv .lane site .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamps are newer than what they depend on once it is installed, the page's libraries too.
.venv/dev.stamp: EXTRAS := [dev]
.venv/coverage.stamp: EXTRAS := [coverage]
.venv/fuzz.stamp: EXTRAS := [fuzz]
.venv/mutation.stamp: EXTRAS := [mutation]
.venv/docs.stamp: EXTRAS := [docs]
.venv/%.stamp: pyproject.toml hatch_build.py skin_host/viewer/npm/package-lock.json | .venv/bin/python
	@echo "installing skin-host$(EXTRAS) into .venv"
	@$(PIP) install --editable '.$(EXTRAS)'
	@touch $@

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed; name it: make PYTHON=..." >&2; exit 1; }
	@echo "creating .venv with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv --clear .venv
