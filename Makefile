PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
VERSION := $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')
READY_DEMO := $(VENV)/.ready-$(VERSION)-for-the-demo
READY := $(VENV)/.ready-$(VERSION)
DEMO := demo
STUDIES := $(shell sed -n 's/^\([a-z0-9-]*\) *;.*/\1/p' studies/judged.txt)
SCORED := $(addprefix scored-,$(filter worth-%,$(STUDIES)))
TASKS := move_from_origin face_direction move_in_direction move_to_position move_to_pose

export PYTHONDONTWRITEBYTECODE :=# empty: kept, or each process that a test starts compiles torch anew

.PHONY: help setup demo test test-all coverage check bench pictures docs figures samples data encoders decoded $(STUDIES) answer programme programme-time worth $(SCORED) policies behaviour clean
help: ## what there is to make
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' | expand -t 12

setup: $(READY) ## a virtual environment with everything in it
$(READY): pyproject.toml constraints.txt | $(VENV)/lib/python$(VERSION)
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[cluster,dm-control,export,learn,logs,render,suite,view,dev]'
	@touch $@ $(READY_DEMO)

$(READY_DEMO): pyproject.toml constraints.txt | $(VENV)/lib/python$(VERSION)
	$(BIN)/python -m pip install --quiet --no-compile --constraint constraints.txt --editable '.[dm-control,learn,view]'
	@touch $@

$(VENV)/lib/python$(VERSION):
	@case "$(VERSION)" in 3.11|3.12) ;; *) echo "this needs Python 3.11 or 3.12, and $(PYTHON) is" \
	  "'$(VERSION)' (dm-control's labmaze has no wheels for newer ones): make PYTHON=python3.12 ..."; exit 2;; esac
	$(PYTHON) -m venv --clear $(VENV)

demo: $(READY_DEMO) ## the whole job in minutes: collect, train and evaluate an encoder, learn, report, record
	rm -rf $(DEMO)
	$(BIN)/jbrep study demo --out $(DEMO)
	$(BIN)/jbrep data info $(DEMO)/data/face_direction
	$(BIN)/jbrep inspect $(DEMO)/runs/face_direction/small-sac/full/seed-0 --out $(DEMO)/run.rrd
	@echo
	@echo "the report: $(DEMO)/report.html"
	@echo "an agent that has learned to turn: $(BIN)/rerun $(DEMO)/run.rrd"

test: $(READY) ## the test suite, in minutes
	$(BIN)/python -m pytest

test-all: $(READY) ## the same with its slow tests
	$(BIN)/python -m pytest -m ''

coverage: $(READY) ## the test suite, with the lines of jbrep/ that no test runs
	$(BIN)/python -m pytest --cov

check: docs lint types layers ## lint, types, import direction, links of the documentation

.PHONY: lint types layers
lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY)
	$(BIN)/mypy
	$(BIN)/mypy tools/*.py
	$(BIN)/mypy benchmarks/*.py

layers: $(READY)
	$(BIN)/lint-imports

bench: $(READY) ## speed as ratios in one run, and what the scripted policies return
	for each in quick throughput dataset encoders methods learning settings inspection heuristics environments; do \
	  MUJOCO_GL=disable KINETO_LOG_LEVEL=10 $(BIN)/python benchmarks/$$each.py || exit; \
	done

pictures: $(READY) ## the pictures in docs/, drawn anew
	rm -f docs/jitterbug.gif
	$(BIN)/jbrep render uniform trained --task move_to_pose --episode 18 --seconds 4 --speed 0.7 --fps 10 --size 240x180 --out docs/jitterbug.gif
	$(BIN)/jbrep inspect data/sample/face_direction --episode 1 --encoder dae-8 --out inspect/shown.rrd
	$(BIN)/jbrep report results/arm
	MUJOCO_GL=egl $(BIN)/python tools/pictures.py results/arm/report.html inspect/shown.rrd docs

docs: $(READY) ## the documentation as a site, in site/
	$(BIN)/python tools/site.py site

figures: $(READY) ## reports in results/ with their figures anew, from the tables there
	$(BIN)/python tools/figures.py

samples: $(READY) ## the sample data sets in data/, made anew
	for task in $(TASKS); do \
	  rm -rf data/sample/$$task; $(BIN)/jbrep collect --task $$task --steps 4k --out data/sample/$$task; done

data: $(READY) ## data sets of five million states in data/, and one million of a cheetah: two hours, 4 GB
	for task in $(TASKS); do $(BIN)/jbrep collect --task $$task --steps 5M --out data/$$task || exit; done
	$(BIN)/jbrep collect --task dm_control/cheetah-run-v0 --steps 1M --out data/cheetah

encoders: data ## results/encoders/ from these: hours; goes on where it was stopped
	$(BIN)/python tools/encoders.py data encoders results/encoders $(TASKS) cheetah

decoded: $(READY) ## results/decoded.txt anew: scripted policies on what encoders give back
	for task in $(TASKS); do \
	  $(BIN)/jbrep evaluate-policy heuristic --task $$task || exit; \
	  for name in dae pca random linear-forward forward; do for latent in 12 8 4; do \
	    $(BIN)/jbrep evaluate-policy heuristic --task $$task --encoder $$name-$$latent || exit; \
	  done; done; \
	done > results/decoded.txt
	sed -i '/^encoder:/d' results/decoded.txt

ablation: ## results/ablation/ anew: hours; goes on where it was stopped, as all studies do
ablation-speed: ## results/ablation-speed/ anew: an hour
screen: ## results/screen/ anew: three hours; makes its own data sets and encoders
screen-normalized: ## results/screen-normalized/ anew: an hour after the screen
confirm: ## results/confirm/ anew: an hour after the screen, on its encoders
confirm-move: ## results/confirm-move/ anew: two hours after the screen, on its encoders
longer: ## results/longer/ anew: half an hour after the screen, on its encoders
breadth: ## results/breadth/ anew: an hour
cheetah: ## results/cheetah/ anew: half an hour
coordinates coordinates-direction: ## results/coordinates/ and -direction/ anew: 20 minutes each
recipe: ## results/recipe/ anew: half an hour
figure-7-sac figure-7-td3: ## results/figure-7-sac/ and -td3/ anew: an hour each
figure-7-ddpg: ## results/figure-7-ddpg/ anew: half an hour
cart-pole: ## results/cart-pole/ anew: half an hour
cart-pole-settings: ## results/cart-pole-settings/ anew: half an hour
cart-pole-often: ## results/cart-pole-often/ anew: forty minutes
cheetah-wide: ## results/cheetah-wide/ anew: forty minutes
cheetah-plateau: ## results/cheetah-plateau/ anew: five to six hours
cheetah-settings: ## results/cheetah-settings/ anew: an hour and a quarter
cheetah-often: ## results/cheetah-often/ anew: two hours
answer-move-to-position: ## results/answer-move-to-position/ anew: two hours
answer-face-direction: ## results/answer-face-direction/ anew: an hour
answer-move-from-origin answer-move-in-direction: ## results/answer-move-from-origin/ and -in-direction/ anew: an hour and a half each
answer-move-to-pose: ## results/answer-move-to-pose/ anew: two hours
identify-face-direction identify-move-in-direction: ## results/identify-…/ anew: an hour each
size-face-direction size-move-in-direction size-move-to-position: ## results/size-…/ anew: an hour or more each
body-1 body-2 body-3: ## results/body-1/, -2/ and -3/ anew: half an hour each
# the columns of a study's line in studies/judged.txt
column = $(shell sed -n 's/^$@ *;//p' studies/judged.txt | cut -d ';' -f $(1))
.SECONDEXPANSION:
# one with claims is refused until it is registered: jbrep study studies/NAME.toml --register, then commit what that writes
$(STUDIES): $(READY) $$(call column,1)
	$(BIN)/jbrep study studies/$@.toml --out runs/$@
	mkdir -p results/$@
	cp $$(ls $(addprefix runs/$@/,returns.csv runs.json references.csv run-infos.csv registration.json) 2>/dev/null) results/$@/
	$(if $(strip $(call column,4)),for task in $(call column,4); do \
	  $(BIN)/jbrep evaluate --encoder $(call column,2) --data $(call column,3) --out results/$@/$$task || exit; \
	done)
	$(BIN)/jbrep report results/$@ $(if $(strip $(call column,4)),--evaluation 'results/$@/{task}')

encoders/ablation encoders/ablation-speed: encoders/%: $(READY)
	$(BIN)/python tools/ablate.py $* $@
data/unseen: $(READY)
	for task in face_direction move_in_direction; do \
	  $(BIN)/jbrep collect --task $$task --steps 500k --seed 100 --out $@/$$task || exit; done

# what the answer rests on, in the order in which it runs
PROGRAMME := $(shell sed -n 's/^\(\(answer\|identify\|size\|body\)-[a-z0-9-]*\) *;.*/\1/p' studies/judged.txt)
answer: $(READY) ## all its tasks side by side, and sizes, from the tables: results/answer.png, small.png
	$(BIN)/python tools/answer.py results/answer.png $(sort $(wildcard results/answer-*))
	$(BIN)/python tools/small.py results/small.png $(sort $(wildcard results/size-* results/small-*))
programme: $(PROGRAMME) ## all studies of the answer, one after another: a night; goes on where it was stopped
programme-time: $(READY) ## how long that takes here, without what has ended
	for study in $(PROGRAMME); do $(BIN)/jbrep study studies/$$study.toml --dry-run --out runs/$$study || exit; done

# whether scores tell which codes serve: scored as soon as they are made, before agents train on them
worth: $(filter worth-%,$(STUDIES)) ## how well they do: seven hours; goes on where it was stopped
	$(BIN)/python tools/worth.py $(addprefix results/,$^)
$(SCORED): scored-%: $(READY)
	$(BIN)/python tools/prepare.py studies/$*.toml runs/$*
	$(BIN)/jbrep evaluate --encoder $$(ls runs/$*/encoders/*/*.safetensors) --data runs/$*/data/* --out results/$*/scores

policies: $(READY) ## the trained policies that ship, anew: an hour and a half; goes on where it was stopped
	for study in policies policies-face-direction policies-move-to-pose; do $(BIN)/jbrep study studies/$$study.toml --out runs/$$study || exit; done
	$(BIN)/python tools/policies.py runs/policies runs/policies-face-direction runs/policies-move-to-pose

behaviour: $(READY) ## results/behaviour/ anew, of the agents of make answer-move-in-direction
	$(BIN)/python examples/paper/behaviour.py $(addprefix runs/answer-move-in-direction/runs/move_in_direction/drawn-sac/,full symmetry forward-8-symmetry dae-12) \
	  --episodes 4 --out results/behaviour

clean: ## remove the environment and the demo's files
	rm -rf $(VENV) $(DEMO) *.egg-info
