"""`python -m cobevglue`: the same as `cobevglue`; what `torchrun -m cobevglue train …` starts."""

import sys

from cobevglue.cli.app import main

if __name__ == "__main__":  # worker processes import this module again where they are spawned
    sys.exit(main())
