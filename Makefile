# Every target runs the setup first. `make` alone lists the targets.

TASK ?= all
SAMPLES ?= 200
OUT ?= data
WORKERS ?= auto
FIDELITY ?= standard
RECIPE ?= laptop
TRIALS ?= 300
FILTERS ?= 64
RUN ?= runs/servo-bust
REAL ?= data/real
EXPERIMENT ?= zero-shot
PYTHON ?=

BIN := .venv/bin
READY := .venv/.ready

help:
	@echo "make setup         .venv with pinned versions, and OpenGL"
	@echo "make sim-dataset   simulated data sets  [TASK=all|surface|edge] [SAMPLES=200] [OUT=data] [WORKERS=auto] [FIDELITY=standard]"
	@echo "make train         a PoseNet on OUT/TASK  [TASK=surface] [OUT=data] [RECIPE=laptop|paper]; into runs/TASK, with its evaluation"
	@echo "make tune          search for a network  [TASK=surface] [OUT=data] [TRIALS=300] [FILTERS=64, the paper's 512 on a GPU]; into runs/tune-TASK"
	@echo "make servo         follow a bust or a rim by touch  [TASK=bust|rim] [OBJECT=...]; into runs/servo-OBJECT"
	@echo "make demo          a pass over the bust and once round a rim, with videos (two minutes); into runs/demo"
	@echo "make replay        a servo run in a browser  [RUN=runs/servo-bust]"
	@echo "make view          the live scene in a browser: drag the stimulus  [TASK=surface|edge]"
	@echo "make transfer      simulation against a real set  [REAL=data/real] [EXPERIMENT=zero-shot|ablate|few-shot|gap|pseudo-real]"
	@echo "make report        measure errors and costs (45 min); write docs/*.md and the README's picture"
	@echo "make reference     rewrite docs/commands.md from the commands' help texts"
	@echo "make test          all tests except the slow ones; make test-all runs those, too"
	@echo "make lint          ruff and pyright"
	@echo "make lock          rewrite requirements.lock"
	@echo "make clean         remove .venv and caches, keep data"

setup: $(READY)

$(READY): pyproject.toml requirements.lock scripts/setup.sh
	@PYTHON="$(PYTHON)" sh scripts/setup.sh
	@touch $@

sim-dataset: $(READY)
	@$(BIN)/tactip dataset make --task "$(TASK)" --split all --samples "$(SAMPLES)" --out "$(OUT)" \
		--workers "$(WORKERS)" --fidelity "$(FIDELITY)"
	@echo "The paper's sets have 2000 samples each: make sim-dataset SAMPLES=2000 OUT=data-2000"

# One task at a time: `make train` alone is the surface.
train tune: LEARNED = $(if $(filter all,$(TASK)),surface,$(TASK))

train: $(READY)
	@$(BIN)/tactip train --data "$(OUT)/$(LEARNED)" --out "runs/$(LEARNED)" --recipe "$(RECIPE)"
	@$(BIN)/tactip evaluate --model "runs/$(LEARNED)" --data "$(OUT)/$(LEARNED)/test" --out "runs/$(LEARNED)/evaluation"

tune: $(READY)
	@$(BIN)/tactip tune --data "$(OUT)/$(LEARNED)" --out "runs/tune-$(LEARNED)" --trials "$(TRIALS)" \
		--max-filters "$(FILTERS)"

# TASK is what is followed: bust or rim (make servo alone is the bust), or surface or edge with OBJECT.
servo: FOLLOWED = $(if $(filter rim edge,$(TASK)),edge,surface)
servo: OBJECT ?= $(if $(filter rim edge,$(TASK)),rim-round,bust)

servo: $(READY)
	@$(BIN)/tactip servo --task "$(FOLLOWED)" --object "$(OBJECT)" --out "runs/servo-$(OBJECT)"

demo: $(READY)
	@rm -rf runs/demo
	@$(BIN)/tactip servo --task surface --object bust --route.kind straight --route.length-mm 40 --video --out runs/demo/bust
	@$(BIN)/tactip servo --task edge --object rim-round --settings.step-mm 2 --video --out runs/demo/rim

replay: $(READY)
	@$(BIN)/tactip replay "$(RUN)"

view: $(READY)
	@$(BIN)/tactip view --task "$(if $(filter all,$(TASK)),surface,$(TASK))"

transfer: $(READY)
	@$(BIN)/tactip transfer "$(EXPERIMENT)" --out "runs/transfer-$(notdir $(REAL))" \
		$(if $(filter pseudo-real,$(EXPERIMENT)),,--real "$(REAL)")

# One test process per core, with one thread each.
test: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist loadscope

test-all: $(READY)
	@$(BIN)/python -m pytest -m ""

report: $(READY)
	@$(BIN)/tactip bench mechanics
	@$(BIN)/tactip bench materials
	@$(BIN)/tactip bench fem-cross-check
	@$(BIN)/tactip bench friction
	@$(BIN)/tactip bench mesh-contact
	@$(BIN)/tactip bench fidelity
	@$(BIN)/tactip bench scene-cost
	@$(BIN)/tactip bench stability
	@$(BIN)/tactip bench real-comparison

lint: $(READY)
	@$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/pyright

reference: $(READY)
	@$(BIN)/python scripts/commands_page.py docs/commands.md

lock:
	@rm -rf .venv-lock && python3.11 -m venv .venv-lock
	@.venv-lock/bin/pip install --quiet torch==2.13.0 && .venv-lock/bin/pip install --quiet '.[dev]'
	@.venv-lock/bin/pip freeze --exclude tactip-twin | sed 's/+cpu$$//' > requirements.lock
	@rm -rf .venv-lock build

clean:
	@rm -rf .venv build *.egg-info .pytest_cache .ruff_cache .hypothesis

.PHONY: help setup sim-dataset train tune servo demo replay view transfer test test-all report reference lint lock clean
