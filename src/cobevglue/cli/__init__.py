"""The command line: `cobevglue --help`. A thin layer over the API; what a command needs is imported when it runs."""

from cobevglue.cli.app import app, main

__all__ = ["app", "main"]
