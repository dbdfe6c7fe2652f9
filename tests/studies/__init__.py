"""Studies whose results the repository keeps: benchmarks, comparisons with published numbers, surveys of runs.

Each is a program: ``PYTHONPATH=tests python -m studies.NAME``; results/README.md lists them.
"""
