"""``python -m jaxltl``: the command of the same name."""

from jaxltl.cli import main

if __name__ == "__main__":
    main()
