"""`python -m cobevglue.cli`: the same as `cobevglue`."""

import sys

from cobevglue.cli.app import main

sys.exit(main())
