"""Command line `cobevglue`, a thin layer over the API. Each command imports its dependencies when it runs."""

from cobevglue.cli.app import app, main

__all__ = ["app", "main"]
