"""`python -m photoplan`: the command line without its script on the path."""

from photoplan.cli.main import main

if __name__ == "__main__":
    main()
