# `make run` does the main job, `make test` checks everything but long experiments, which
# `make test-all` adds. Each sets up .venv first; Python 3.11 or newer and make are all that a
# fresh machine needs.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
ARGS ?=
# Recordings with stops and waves, then motorways; with ARGS only what they say.
BOTH := -m data=stop_and_go,platoons

# One thread per process: two trainings run side by side, and results depend on the number.
export OMP_NUM_THREADS ?= 1

.PHONY: install run test test-all extras coverage lint size benchmarks findings docs clean

install: $(STAMP)

run: $(STAMP)
	$(BIN)/python -m lcc_rl run $(or $(ARGS),$(BOTH))

test: lint
	$(BIN)/python -m pytest -n 2 --dist worksteal --durations 20 -m "not slow" $(ARGS)

test-all: lint
	$(BIN)/python -m pytest -n 2 --dist loadgroup $(ARGS)

# Without them, test-all skips their tests: interfaces, the site, SUMO …
extras: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --constraint constraints/extras.txt --editable ".[test,interfaces,docs,bench,sumo,sweeps]"

coverage: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow" --cov $(ARGS)

lint: $(STAMP)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python tools/size.py --check

# Lines, code, guards, tests and cases; make lint checks the ceilings of tools/size.py.
size: $(STAMP)
	$(BIN)/python tools/size.py

# All benchmarks on two cores, three repeats each, and their rows as Markdown; needs the extras.
BENCHMARK := $(BIN)/python tools/benchmarks
ROWS := outputs/benchmarks
benchmarks: $(STAMP)
	mkdir -p $(ROWS)
	$(BENCHMARK) env collect string start gym evaluate analytic --repeats 3 --out $(ROWS)/1.parquet $(ARGS) & \
	$(BENCHMARK) update train calibrate read simulate --repeats 3 --out $(ROWS)/2.parquet $(ARGS) & wait
	$(BENCHMARK) --page $(ROWS)/1.parquet $(ROWS)/2.parquet | tee $(ROWS)/page.md

# Surprises of other libraries, each in an environment of its own; 20 minutes, not part of tests.
findings:
	@status=0; for script in findings/*.sh; do echo "== $$script"; bash $$script; code=$$?; \
	case $$code in 0) word="as described" ;; 2) word="not installed" ;; *) word=CHANGED ;; esac; \
	test $$code = 0 || status=1; list="$$list$$script: $$word\n"; done; \
	printf "\n$$list"; exit $$status

# Strict: a broken link or name is an error. Needs no network once the extra is installed.
# Notebooks run if they have changed, ten minutes; ARGS="-D nb_execution_mode=off" leaves them out.
docs: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --constraint constraints/extras.txt --editable ".[docs]"
	$(BIN)/python -m sphinx --fail-on-warning --keep-going --quiet docs site $(ARGS)

$(STAMP): pyproject.toml constraints.txt lcc_rl/version.py
	@$(PYTHON) -c 'import sys; v = sys.version_info; sys.exit(v < (3, 11) and "lcc_rl needs Python 3.11 or newer, %s is %d.%d; use make PYTHON=python3.12" % (sys.executable, v[0], v[1]))'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	PYTHONWARNINGS=ignore $(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[test]"
	@touch $(STAMP)

clean:
	rm -rf $(VENV) build *.egg-info
