# Everything runs in .venv, which the first target that needs it makes. `make help` lists what there is.
# Words such as TEXT="..." or trainer.max_steps=10 are make variables. The commands read them from what make hands
# down (--from-make), not through a shell, so that quotes, brackets and dollar signs in them survive.
.DEFAULT_GOAL := help
PYTHON ?= python3
VENV := .venv
READY := $(VENV)/.ready
export MAKEFLAGS

.PHONY: help setup prepare browse train sample evaluate tables benchmark edit convert report compare test lint bench

help: ## show this
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## /  make \1@/' | column -t -s @
	@echo "experiments (EXP=...):"
	@cd experiments && grep -rl "@package _global_" --include=*.yaml . | sed 's|^\./|  |;s|\.yaml$$||' | sort

setup: $(READY) ## install into .venv

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install -q -c constraints.txt -e '.[dev,offline]'
	@touch $@

prepare: $(READY) ## prepare a data set, or report on it: DATA=bandai SOURCE=/path/to/folder-or-archive [verify=true]
	@$(VENV)/bin/python -m flame_mdm.prepare --from-make

browse: $(READY) ## one web page of a data set: DATA=bandai [SPLIT=train SEARCH="waves left" CLIPS=200 MOTIONS=folder]
	@$(VENV)/bin/python -m flame_mdm.browse --from-make

train: $(READY) ## train or resume: EXP=quickstart [trainer.max_steps=1000 denoiser=mdm_decoder ...]
	@$(VENV)/bin/python -m flame_mdm.train --from-make

sample: $(READY) ## sample: CKPT=runs/.../last.ckpt TEXT="a person walks in a circle" SECONDS=3
	@$(VENV)/bin/python -m flame_mdm.sample --from-make

evaluate: $(READY) ## measure: CKPT=runs/.../last.ckpt [protocol=synthetic] extractor=runs/motion_clip/... [quick=true]
	@$(VENV)/bin/python -m flame_mdm.evaluate --from-make

tables: $(READY) ## tables and figures from checkpoints: [TABLE="mdm_1 synthetic"] [evaluate=false]
	@$(VENV)/bin/python -m flame_mdm.tables --from-make

benchmark: $(READY) ## train and measure small models of all kinds, write a report: EXP=synthetic (or bandai)
	@$(VENV)/bin/python -m flame_mdm.benchmark --from-make

edit: $(READY) ## keep a part of a motion, sample the rest: CKPT=... MOTION=walk.npz FRAMES=in_between TEXT="a person jumps"
	@$(VENV)/bin/python -m flame_mdm.edit --from-make

convert: $(READY) ## motion files for other programs: INPUT=motion.npz OUT=walk.bvh|.glb|.npz|.json|.npy
	@$(VENV)/bin/python -m flame_mdm.convert --from-make

report: $(READY) ## a run on one web page, as training writes it at its end: RUNS=runs/quickstart/default
	@$(VENV)/bin/python -m flame_mdm.report --from-make

compare: $(READY) ## runs side by side: RUNS="runs/a/default runs/b/default" [RATE=true TEXTS="a person walks; ..."]
	@$(VENV)/bin/python -m flame_mdm.compare --from-make

test: $(READY) ## run all tests
	@$(VENV)/bin/python -m pytest -n 2 --dist worksteal

lint: $(READY) ## check style and types
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/pyright

bench: $(READY) ## measure speed, as ratios in one run
	@for name in features loading text sampling startup ddp; do \
		echo "== $$name"; $(VENV)/bin/python benchmarks/$$name.py || exit 1; done
