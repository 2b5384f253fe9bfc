# Two commands: `make demo` shows it, `make test` checks it. `make help` lists the rest.

PYTHON ?= $(firstword $(foreach p,python3 python3.14 python3.13 python3.12 python3.11,$(shell \
	$(p) -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $(p))))
BIN := .venv/bin
PIP := $(BIN)/python -m pip --quiet --quiet --disable-pip-version-check --no-input

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo test test-system install uninstall lint format clean

help:  ## this list
	@awk -F ':.*## ' '/^[a-z.-]+:.*## / {printf "make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

demo: .venv/demo.stamp  ## emulator, daemon, broker and page together; DURATION=15 ends by itself
	@exec $(BIN)/skin demo $(if $(DURATION),--duration $(DURATION))

test: lint  ## all that needs no root and no hardware
	@$(BIN)/python -m pytest --numprocesses=3 --dist=loadfile

test-system: .venv/dev.stamp .venv/fuzz.stamp  ## real CAN, I2C, broker and browser; root, if packages are missing
	@tools/lane/packages
	@$(BIN)/python -m compileall -q skin_host emulator tests
	@echo "on this host: broker, browser, the lane itself"
	@$(BIN)/python -m pytest tests/system/native --require-mosquitto
	@$(BIN)/python -m pytest tests -m mosquitto --require-mosquitto
	@echo "in the lane: vcan and CUSE"
	@tools/lane/run $(BIN)/python -m pytest $(wildcard tests/stack) tests/system/lane \
		--bus=vcan --require-mosquitto -o faulthandler_timeout=300

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
	rm -rf .venv .lane .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamps are newer than pyproject.toml once its dependencies are installed.
.venv/dev.stamp: EXTRAS := dev
.venv/fuzz.stamp: EXTRAS := fuzz
.venv/demo.stamp: EXTRAS := demo
.venv/%.stamp: pyproject.toml | .venv/bin/python
	@echo "installing skin-host[$(EXTRAS)] into .venv"
	@$(PIP) install --editable '.[$(EXTRAS)]'
	@touch $@

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed; name it: make PYTHON=..." >&2; exit 1; }
	@echo "creating .venv with $$($(PYTHON) --version)"
	@$(PYTHON) -m venv --clear .venv
