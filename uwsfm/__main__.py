"""`python -m uwsfm`: the command line where its script is not on the path."""

from uwsfm.cli.app import main

if __name__ == "__main__":
    main()
