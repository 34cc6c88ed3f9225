"""python -m sobolev_batch: the command line."""

from sobolev_batch.cli import main

if __name__ == "__main__":
    main()
