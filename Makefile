# `make demo` and `make test` set up what they need the first time; `make help` lists the rest.
# A sourced ROS (ROS_DISTRO is set) is used; without one, rclpy comes from wheels. PYTHON=python3.12 chooses the Python.
SHELL := bash
BIN   := .venv/bin
ROS   := $(or $(ROS_DISTRO),wheels)
READY := .venv/.ready-$(ROS)
DEV   := .venv/.ready-dev
export MPLBACKEND := Agg

.PHONY: help demo test slow mutants faults fuzz soak lint docs format build clean
.DEFAULT_GOAL := help

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*##/\t/' | expand -t 10

demo: $(READY)  ## a partial cloud from a bag, through the ROS 2 node, to a pose with a confidence; report in demo_output/
	$(BIN)/gapr demo $(ARGS)

test: $(READY)  ## the test suite, under ten minutes on two cores; ARGS="-k node" chooses
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 2 $(ARGS)

slow: $(READY)  ## the tests that take longer
	$(BIN)/python -m pytest -m slow $(ARGS)

mutants: $(DEV)  ## change one operator of a formula at a time: does a test notice? ARGS="--files rules" chooses
	$(BIN)/python scripts/mutants.py $(ARGS)

faults: $(READY)  ## a table of faults on real processes of the node
	$(BIN)/python test/ros/faults.py $(ARGS)

fuzz: $(READY)  ## 100 000 mutated PointCloud2 through the node's reader, 20 000 files of all formats; ARGS="--seed 2" for others
	$(BIN)/python test/ros/fuzz.py $(ARGS)
	$(BIN)/python test/fuzz/files.py $(ARGS)
	$(BIN)/python test/fuzz/packed.py $(ARGS)

soak: $(READY)  ## sweeps and scenes at 10 Hz: every cloud is answered or counted; ARGS="--minutes 60 --out soak" is an hour
	$(BIN)/python test/ros/soak.py $(ARGS)

lint: $(DEV)  ## ruff, mypy and the import contracts, on every file
	PATH="$(CURDIR)/$(BIN):$$PATH" pre-commit run --all-files

docs: $(DEV)  ## the site in build/site; fails on a warning
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

format: $(DEV)  ## let ruff format the code
	$(BIN)/ruff check --fix . ; $(BIN)/ruff format .

build: $(READY)  ## colcon build; then `source install/setup.bash`
	PATH="$(CURDIR)/$(BIN):$$PATH" colcon build --packages-select gapr_ros

clean:  ## everything that was made here, the virtual environment too
	rm -rf .venv build install log demo_output .pytest_cache .mypy_cache .ruff_cache .import_linter_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(READY): setup.py scripts/setup.sh
	@scripts/setup.sh
	@touch $@

$(DEV): $(READY)
	$(BIN)/pip install --quiet --editable '.[dev]'
	@touch $@
