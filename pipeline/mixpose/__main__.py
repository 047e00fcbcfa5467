"""``python -m mixpose``: the command line."""

from mixpose.cli import main

if __name__ == "__main__":
    main()
