# demo   dress a body on a fresh machine: environment in .venv, install, out/demo
# lab    the same, then JupyterLab at the map notebook
# test   the whole test suite with the notebooks
# check  ruff, pyright, import-linter
# html   the notebooks as pages with pictures, out/notebooks, for people without Python

PYTHON ?= python3
WORKERS ?= 2
BIN := .venv/bin
OUT ?= out/demo
PAGES ?= out/notebooks

.PHONY: demo lab test check html
.DEFAULT_GOAL := demo

demo: .venv/installed-core
	$(BIN)/workbench demo --out $(OUT)

lab: .venv/installed-lab
	$(BIN)/jupyter lab notebooks/00_map.ipynb

# One thread a worker: two workers share two cores. Files stay together, so that what a file prepares is made once.
test: .venv/installed-test
	OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --nbmake

# Pictures come before widgets, which a page without a kernel cannot show; links lead from page to page.
html: .venv/installed-lab
	$(BIN)/jupyter nbconvert --to html --execute --ExecutePreprocessor.store_widget_state=False \
	  --output-dir $(PAGES) notebooks/*.ipynb \
	  --NbConvertBase.display_data_priority="['image/png', 'text/html', 'text/markdown', 'text/plain']"
	@sed -i.bak 's/\.ipynb"/.html"/g' $(PAGES)/*.html && rm $(PAGES)/*.html.bak
	@for page in $(PAGES)/*.html; do \
	  grep -q 'data:image/png;base64' "$$page" || { echo "$$page has no picture"; exit 1; }; done

check: .venv/installed-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

.venv/installed-core: EXTRAS =
.venv/installed-lab: EXTRAS = [lab]
.venv/installed-test: EXTRAS = [test]

# Made anew only when what is to be installed changed.
.venv/installed-%: pyproject.toml constraints.txt | .venv/bin/python
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e ".$(EXTRAS)"
	@touch $@

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is needed, $(PYTHON) is older or absent: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv .venv
