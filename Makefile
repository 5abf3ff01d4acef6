# Everything runs from a virtual environment that is made on the first call; later calls find it made.
VENV ?= .venv
WORKERS ?= 2
BIN := $(VENV)/bin
USE := $(VENV)/.ready
DEVELOP := $(VENV)/.ready-dev
WHAT_DECIDES := pyproject.toml setup.cfg constraints.txt scripts/setup
# Bytecode is kept, whatever the environment says: else each of many processes compiles all sources again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test fuzz lint types bench docs clean setup dev

demo: $(USE)  ## meshes, training, new views and a page about them: runs/demo/report.html
	$(BIN)/hyperplanes demo $(DEMO)

test: $(DEVELOP)  ## all tests, on the CPU, by two processes (WORKERS=8: more)
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadscope --no-loadscope-reorder $(TESTS)

fuzz: $(DEVELOP)  ## 10,000 damaged files are read or refused in one line
	$(BIN)/python -m tests.fuzz --files 10000 $(FUZZ)

lint: $(DEVELOP)  ## style and docstrings
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(DEVELOP)  ## static types
	$(BIN)/pyright --pythonpath $(BIN)/python

bench: $(DEVELOP)  ## the benchmarks that need no data of yours, the short way
	for name in lookup visibility rendering training generation; do \
		if [ -f benchmarks/$$name.py ]; then $(BIN)/python -m benchmarks $$name --quick || exit 1; fi; \
	done

docs: $(DEVELOP)  ## all pages, tutorials and the reference as one site in build/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

clean:  ## what was built; environments and runs/ stay
	rm -rf build dist *.egg-info .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

setup: $(USE)
dev: $(DEVELOP)

$(USE): $(WHAT_DECIDES)
	scripts/setup $(VENV)
	touch $@

$(DEVELOP): $(WHAT_DECIDES)
	scripts/setup $(VENV) dev
	touch $@ $(USE)
