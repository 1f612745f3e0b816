# The two commands of the README, and what they need. Run "make" for the list.
SERVE ?= 1
TIERS ?=

.DEFAULT_GOAL := help
.PHONY: help demo test install environment docs-serve clean

help:
	@echo "make demo              install, run a small experiment, serve it on http://127.0.0.1:5000"
	@echo "make demo SERVE=0      the same, ends after the table of results"
	@echo "make test              everything that this machine can test; names what it cannot"
	@echo "make test TIERS='...'  only some of: types lint imports docs unit quick integration mysql browser docker images clusters systems"
	@echo "make install           .venv with what running needs, nothing else; see docs/server.md"
	@echo "make environment       .venv with all development tools, nothing else"
	@echo "make docs-serve        the documentation on http://127.0.0.1:8000"
	@echo "make clean             remove .venv and everything that was built (keeps data/)"

demo:
	@python=$$(sh tools/find-python.sh) && "$$python" tools/bootstrap.py demo
	@.venv/bin/slamhive demo $(if $(filter 0 no false,$(SERVE)),--no-serve,--serve)

test:
	@python=$$(sh tools/find-python.sh) && "$$python" tools/bootstrap.py test $(TIERS)
	@.venv/bin/python tools/test.py $(TIERS)

install:
	@python=$$(sh tools/find-python.sh) && "$$python" tools/bootstrap.py demo
	@.venv/bin/python -m compileall -q slamhive  # services may not write here, and would compile at each start

environment:
	@python=$$(sh tools/find-python.sh) && "$$python" tools/bootstrap.py environment

docs-serve: environment
	@NO_MKDOCS_2_WARNING=1 .venv/bin/mkdocs serve --dev-addr 127.0.0.1:8000

clean:
	rm -rf .venv build dist site *.egg-info .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
	find . -name __pycache__ -not -path './data/*' -prune -exec rm -rf {} +
