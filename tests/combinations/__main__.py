"""``python -m combinations``: see :mod:`combinations.study`."""

from combinations import study

if __name__ == "__main__":
    raise SystemExit(study.main())
