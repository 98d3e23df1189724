# Thin: every target calls the command `stmnist`, which offers the same and more (stmnist --help).
#
# Variables: DATA (ST-MNIST zip or folder; default: simulated), INPUT (image, the default, slices
# or events), RUN (default runs/default), SEED (default 0), SAMPLES (default 200), STEPS (default 100
# of 1 ms, or with events as many as the longest recording needs), JOBS (default 2),
# TARGET (of make check; default emulator), BOARD, PARTITION and CHIPS (of make loihi-hardware),
# SET (other settings, such as SET="cnn.epochs=5 snn.max_rates=[150, 100]"),
# PYTHON (of 3.11 to 3.13; default: the first on the path that fits).
# Unset ones leave a run's own settings as they are.

RUN ?= runs/default
JOBS ?= 2
TARGET ?= emulator
PYTHON38 ?= $(shell sh setup.sh --find 3.8)

BIN := .venv/bin
STMNIST := $(BIN)/stmnist
DATA_OPTIONS := $(if $(DATA),--data "$(DATA)") $(if $(SEED),--seed $(SEED)) --jobs $(JOBS)
# By way of the environment, so that no value is taken apart at its blanks or quotation marks.
export SET
SET_OPTIONS := $(if $(SET),--set "$$SET")
SOURCE_OPTIONS := $(DATA_OPTIONS) $(if $(INPUT),--input $(INPUT)) $(SET_OPTIONS)
CHIP_OPTIONS := $(if $(CHIPS),--chips $(CHIPS))
BOARD_OPTIONS := $(if $(BOARD),--board $(BOARD)) $(if $(PARTITION),--partition $(PARTITION)) $(CHIP_OPTIONS)
DOCUMENT_TESTS := tests/documents tests/experiments
ON_ALL_CORES := --numprocesses logical --maxprocesses 4 --dist worksteal
OPTIONS := $(SOURCE_OPTIONS) $(if $(SAMPLES),--samples $(SAMPLES)) $(if $(STEPS),--steps $(STEPS))

.PHONY: setup data train convert loihi-emulate loihi-hardware check benchmark results report live shipped-bundle docs test test-documents test-pythons lint check-code setup-inrc test-inrc setup-nir test-nir check-nir setup-peers test-peers audit clean help
.DEFAULT_GOAL := help

setup:  ## Install the versions pinned in constraints.txt into .venv (3 GB)
	@sh setup.sh .venv $(PYTHON)

data: setup  ## Import DATA, or simulate recordings, into the cache
	@$(STMNIST) data import "$(or $(DATA),simulated)" --jobs $(JOBS)

train: setup  ## Train the paper's CNN
	@$(STMNIST) train "$(RUN)" $(SOURCE_OPTIONS)

convert: setup  ## Train with rate-LIF neurons, convert to spiking ones, write RUN/bundle
	@$(STMNIST) convert "$(RUN)" $(OPTIONS)

loihi-emulate: setup  ## The main job: all stages, and the loss ladder up to the Loihi emulator
	@$(STMNIST) ladder "$(RUN)" $(OPTIONS)

loihi-hardware: setup  ## Run the check on a Loihi board (needs NxSDK; BOARD, PARTITION, CHIPS)
	@$(BIN)/python -m deploy board
	@$(MAKE) --no-print-directory convert
	@$(STMNIST) deploy plan "$(RUN)/bundle" $(CHIP_OPTIONS)
	@$(STMNIST) check run "$(RUN)/bundle" --target loihi $(BOARD_OPTIONS)

check: convert  ## Run the check on TARGET, and compare it with the reference simulator
	@$(STMNIST) check run "$(RUN)/bundle" --target nengo
	@$(STMNIST) check run "$(RUN)/bundle" --target $(TARGET)
	@$(STMNIST) check compare "$(RUN)/checks/nengo.json" "$(RUN)/checks/$(TARGET).json"

benchmark: setup  ## Measure the paper's Table 2 on ten splits (hours)
	@$(BIN)/python -m experiments table2 --out "$$(dirname "$(RUN)")/table2" $(DATA_OPTIONS) $(SET_OPTIONS) $(if $(STEPS),--set presentation.steps=$(STEPS))

results: setup  ## List what can be measured again for results/, with its time (maintainers)
	@$(BIN)/python -m experiments

report: loihi-emulate  ## Write the results of RUN as one HTML file, RUN/report.html
	@$(STMNIST) report "$(RUN)"

live: setup  ## Write digits in the browser (RUN: its network; PORT; RECORD: folder)
	@$(STMNIST) live $(if $(filter file,$(origin RUN)),,"$(RUN)") $(if $(PORT),--port $(PORT)) $(if $(RECORD),--record "$(RECORD)")

shipped-bundle: setup  ## Train the network that comes with the package, in pipeline/live/bundle, again
	@$(STMNIST) convert runs/shipped --settings pipeline/live/shipped.toml --jobs $(JOBS)
	@rm -rf pipeline/live/bundle && cp -r runs/shipped/bundle pipeline/live/bundle

docs: setup  ## Build the documentation site, build/site, and fail on broken links
	@NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet
	@echo build/site/index.html

test: setup  ## Run the tests of the product, on at most four cores
	@$(BIN)/python -m pytest $(ON_ALL_CORES) $(addprefix --ignore=,$(DOCUMENT_TESTS))

test-documents: setup  ## Execute the documents, the examples and the experiments, and test their results
	@$(BIN)/python -m pytest $(ON_ALL_CORES) $(DOCUMENT_TESTS)

test-pythons:  ## Run the tests on each of Python 3.11 to 3.13 that this machine has (TESTS: options)
	@for version in 3.11 3.12 3.13; do \
	  python=$$(sh setup.sh --find $$version) || { echo "Python $$version: not on this machine"; continue; }; \
	  sh setup.sh .venv-$$version "$$python" && echo "Python $$version:" && \
	  .venv-$$version/bin/python -m pytest $(ON_ALL_CORES) $(TESTS) || exit; \
	done

lint: setup  ## Check style
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .

check-code: lint  ## Check style and types
	@$(BIN)/mypy

setup-inrc: .venv-inrc/installed  ## Make .venv-inrc, the Python 3.8 of an INRC host, for the tests

.venv-inrc/installed: deploy/inrc/requirements.txt
	@test -n "$(PYTHON38)" && "$(PYTHON38)" -c 'import sys; sys.exit(sys.version_info[:2] != (3, 8))' 2>/dev/null || \
	  { echo "setup-inrc: Python 3.8 is needed; install one, or name it with PYTHON38=/path/to/python3.8" >&2; exit 2; }
	@$(PYTHON38) -m venv --clear .venv-inrc
	@.venv-inrc/bin/pip install -qq -r deploy/inrc/requirements.txt
	@touch $@

test-inrc: setup setup-inrc  ## Test that a copied bundle gives the same result on Python 3.8
	@$(BIN)/python -m pytest tests/deploy/test_travel.py -k python_38

setup-nir: .venv-nir/installed  ## Make .venv-nir with Norse and PyTorch for the CPU, which read NIR (1 GB)

.venv-nir/installed: tests/nir_reader/requirements.txt | setup
	@$(BIN)/python -m venv --clear .venv-nir
	@.venv-nir/bin/pip install -qq -r tests/nir_reader/requirements.txt
	@.venv-nir/bin/pip install -qq --no-deps norse==1.1.0 snntorch==1.0.0 \
		spikingjelly==2.0.0 rockpool==3.1.0 sinabs==3.1.3
	@touch $@

test-nir: setup setup-nir  ## Test exports in Norse, and imports of networks trained in PyTorch (minutes)
	@TEST_NIR=1 $(BIN)/python -m pytest tests/deploy/network/test_nir.py tests/nir_networks

check-nir: convert setup-nir  ## Run the check's samples in Norse, and compare with checks/emulator.json
	@$(STMNIST) check run "$(RUN)/bundle" --target emulator
	@$(STMNIST) deploy export "$(RUN)/bundle" --format nir --out "$(RUN)/norse/network.nir" --inputs "$(RUN)/norse/input.npz"
	@.venv-nir/bin/python tests/nir_reader/run_norse.py "$(RUN)/norse/network.nir" "$(RUN)/norse/input.npz" "$(RUN)/norse/output.npz"
	@$(BIN)/python -m tests.nir_reader.result "$(RUN)/bundle" "$(RUN)/norse/input.npz" "$(RUN)/norse/output.npz" "$(RUN)/checks/norse.json"
	@$(STMNIST) check compare "$(RUN)/checks/emulator.json" "$(RUN)/checks/norse.json"

setup-peers: .venv-peers/installed  ## Install the pytest plugins that NengoLoihi's tests need

.venv-peers/installed: tests/peers/requirements.txt | setup
	@rm -rf .venv-peers
	@$(BIN)/python -m pip install -qq --no-deps --target .venv-peers -r tests/peers/requirements.txt
	@touch $@

test-peers: setup setup-peers  ## Run the tests of NengoLoihi (on its emulator, ours and both) and of NengoDL
	@for emulator in nengo-loihi fast both; do echo "NengoLoihi's tests, emulator: $$emulator" && \
	  $(BIN)/python -m tests.peers loihi --emulator $$emulator $(ON_ALL_CORES) || exit; done
	@echo "NengoDL's tests" && $(BIN)/python -m tests.peers dl $(ON_ALL_CORES)

# Those that SECURITY.md explains; pip-audit says how many it leaves out.
EXPLAINED = $(shell sed -n 's/^- \*\*\(CVE-[0-9-]*\)\*\*.*/\1/p' SECURITY.md)

audit: .venv-audit/installed  ## Look up known vulnerabilities of the pinned versions (AUDIT: options)
	@.venv-audit/bin/pip-audit --strict --disable-pip --no-deps --progress-spinner off \
	  $(addprefix --ignore-vuln ,$(EXPLAINED)) $(AUDIT) -r constraints.txt

.venv-audit/installed: | setup
	@$(BIN)/python -m venv --clear .venv-audit
	@.venv-audit/bin/pip install -qq pip-audit==2.10.1
	@touch $@

clean:  ## Remove the run RUN; other folders, the cache and .venv are kept
	@if [ -f "$(RUN)/experiment.toml" ]; then rm -rf -- "$(RUN)"; \
	elif [ -e "$(RUN)" ]; then \
	  echo "clean: $(RUN): not a run (it has no experiment.toml), so it is kept" >&2; exit 2; fi

help:  ## List the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-15s %s\n", $$1, $$2}' Makefile
