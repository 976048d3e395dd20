# make setup            Install what the project needs.
# make demo             Record, train and evaluate one visuotactile policy, and write its report.
# make data             Record as many demonstrations of every task as the paper, in hours; it continues where it was stopped.
# make benchmark-smoke  Run the whole benchmark with two tasks and tiny networks.
# make test             Run the test suite.   make lint types docs  Run the checks of the code and build the site.
# make results          Make the pages with published results anew, from the result files in leaderboard/ and docs/.
# make lock             Pin the newest versions that pyproject.toml allows in requirements.lock.
# Every target first installs what is missing. Demonstrations and a trained policy that are there are kept, also after a change
# of TASK_ARGS or of the code: delete runs/demo to begin anew.
SHELL := /bin/bash
PYTHON := .venv/bin/python
RUN := runs/demo
DEMOS := $(RUN)/demos/trajectory.h5
TASK := ManiFeel-PegInsertion-v1
# half of the paper's ranges, for a small network that learns from 120 demonstrations in minutes; the report states them
TASK_ARGS := {"randomization": {"socket_xy": 0.025, "start_xy": 0.05, "start_z": 0.025, "start_rotation": 0.05, "in_hand_pitch": 0.0873}}
READY := .venv/.ready
WORKERS := $(shell nproc)
# keep compiled modules even if the shell forbids it, so that not every process compiles them again
export PYTHONDONTWRITEBYTECODE :=

.PHONY: setup demo data benchmark-smoke test lint types docs results lock
setup: $(READY)

$(READY): pyproject.toml requirements.lock scripts/setup.sh
	scripts/setup.sh
	touch $@

demo: $(RUN)/report.html
	@echo "The report: $(abspath $<)"

$(DEMOS): | $(READY)
	$(PYTHON) -m manifeel_ms3.demonstrations.record $(TASK) --num-demos 120 --num-procs 2 --out $@ \
		--obs-mode rgb+tacff --cameras wrist --tactile-sensors right --env-kwargs '$(TASK_ARGS)'

$(RUN)/.trained: | $(DEMOS)
	$(PYTHON) baselines/diffusion_policy/train.py cpu_targets --total-iters 7000 --demo-path $(DEMOS) --obs-mode rgb+tacff \
		--run-dir $(RUN) $$(ls $(RUN)/checkpoints/*/config.json >/dev/null 2>&1 && echo --resume)
	touch $@

$(RUN)/evaluation.json: $(RUN)/.trained
	$(PYTHON) -m manifeel_ms3.evaluation.evaluate --checkpoint $(RUN)/checkpoints/last --num-eval-episodes 10 --num-eval-envs 2 \
		--out $@ --env-kwargs '$(TASK_ARGS)'

$(RUN)/report.html: $(RUN)/evaluation.json
	$(PYTHON) -m manifeel_ms3.evaluation.report --run-dir $(RUN)

data: $(READY)
	$(PYTHON) -m manifeel_ms3.demonstrations.dataset --num-procs $(WORKERS) --out data/demos

benchmark-smoke: $(READY)
	$(PYTHON) -m baselines.studies configs/smoke.yaml --root runs/smoke
	$(PYTHON) -m manifeel_ms3.analysis.results_page --results runs/smoke --out runs/smoke/results.md

# three processes keep two cores busy, since tests also wait for processes and files
test: $(READY)
	OMP_NUM_THREADS=1 .venv/bin/pytest -n 3 --dist loadfile --no-loadscope-reorder --durations 12

lint: $(READY)
	.venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/lint-imports

types: $(READY)
	.venv/bin/pyright

docs: $(READY)
	$(PYTHON) -m mkdocs build --quiet --strict --site-dir runs/site

results: $(READY)
	$(PYTHON) -m manifeel_ms3.analysis.results_page --results leaderboard/cpu* docs/cpu* --audit docs/audit.md \
		--study configs/tables_cpu.yaml --out docs/results.md
	$(PYTHON) -m docs.make_readme_results
	$(PYTHON) -m docs.make_fidelity
	$(PYTHON) -m docs.make_task_cards
	$(PYTHON) -m docs.make_perturbation

# for Python 3.10 to 3.12; only this target needs uv. --upgrade takes newer versions than those that were pinned.
# sympy: torch needs it, and torch itself is left out (pyproject.toml says why).
# `similarity` is left out: torch-fidelity needs torchvision, of which there is no build for the pinned torch without CUDA
EXTRAS := train report lerobot zarr audit study teleop spacemouse gamepad view docs dev
lock:
	echo sympy | uv pip compile --universal --python-version 3.10 --upgrade --generate-hashes --no-emit-index-url --no-annotate \
		--custom-compile-command "make lock" $(EXTRAS:%=--extra %) --quiet --output-file requirements.lock pyproject.toml -
