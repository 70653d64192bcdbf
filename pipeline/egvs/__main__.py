"""``python -m egvs``: the command line."""

from egvs.cli.app import main

if __name__ == "__main__":
    main()
