# Thin: every target calls the command `stmnist`, which offers the same and more (stmnist --help).
#
# Variables: DATA (ST-MNIST zip or folder; default: simulated), RUN (default runs/default),
# SEED (default 0), SAMPLES (default 200), STEPS (of 1 ms; default 100), JOBS (default 2),
# TARGET (of make check; default emulator).  Unset ones leave a run's own settings as they are.

RUN ?= runs/default
JOBS ?= 2
TARGET ?= emulator
PYTHON ?= python3.11

BIN := .venv/bin
STMNIST := $(BIN)/stmnist
SOURCE_OPTIONS := $(if $(DATA),--data "$(DATA)") $(if $(SEED),--seed $(SEED)) --jobs $(JOBS)
OPTIONS := $(SOURCE_OPTIONS) $(if $(SAMPLES),--samples $(SAMPLES)) $(if $(STEPS),--steps $(STEPS))

.PHONY: setup data train convert loihi-emulate loihi-hardware check benchmark report test lint clean help
.DEFAULT_GOAL := help

setup: .venv/installed  ## Make .venv with everything pinned in constraints.txt (2.5 GB)

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' 2>/dev/null || \
	  { echo "setup: Python 3.11 is needed (TensorFlow 2.12 and NengoDL 3.6 run on no later one) and '$(PYTHON)' is not it; install it, or name it with PYTHON=/path/to/python3.11" >&2; exit 2; }
	@echo "setup: installing into .venv, about two minutes"
	@$(PYTHON) -m venv --clear .venv
	@$(BIN)/pip install -qq -c constraints.txt -e '.[dev,fast,nir,cluster]'
	@touch $@

data: setup  ## Import DATA, or simulate recordings, into the cache
	@$(STMNIST) data import $(or $(DATA),simulated) --jobs $(JOBS)

train: setup  ## Train the paper's CNN
	@$(STMNIST) train $(RUN) $(SOURCE_OPTIONS)

convert: setup  ## Train with rate LIF neurons, make them spike, write RUN/bundle
	@$(STMNIST) convert $(RUN) $(OPTIONS)

loihi-emulate: setup  ## The main job: everything up to the loss ladder on the Loihi emulator
	@$(STMNIST) ladder $(RUN) $(OPTIONS)

loihi-hardware: convert  ## The same samples on a Loihi board (needs NxSDK)
	@$(STMNIST) check run $(RUN)/bundle --target loihi

check: convert  ## The bundle's check on TARGET, next to the reference simulator's answers
	@$(STMNIST) check run $(RUN)/bundle --target nengo
	@$(STMNIST) check run $(RUN)/bundle --target $(TARGET)
	@$(STMNIST) check compare $(RUN)/checks/nengo.json $(RUN)/checks/$(TARGET).json

test: setup  ## Run the tests
	@$(BIN)/python -m pytest

lint: setup  ## Check style
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

clean:  ## Remove the run RUN; the cache and .venv stay
	@rm -rf $(RUN)

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-15s %s\n", $$1, $$2}' Makefile
