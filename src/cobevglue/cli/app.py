"""The program `cobevglue`: commands, exit codes, and errors as one line on standard error."""

from __future__ import annotations

import inspect
import re
from collections.abc import Sequence
from typing import Annotated

import typer
from typer.main import get_command

import cobevglue
from cobevglue.cli.align import align
from cobevglue.cli.bench import bench
from cobevglue.cli.demo import demo
from cobevglue.cli.errors import InputError
from cobevglue.cli.evaluate import evaluate
from cobevglue.cli.node import node
from cobevglue.cli.output import print_note
from cobevglue.cli.replay import replay
from cobevglue.cli.reproduce import reproduce
from cobevglue.cli.simulate import simulate
from cobevglue.cli.train import train

__all__ = ["BAD_INPUT", "INTERRUPTED", "REFUSED", "app", "main"]

BAD_INPUT, REFUSED, INTERRUPTED = 2, 3, 130
"""Exit codes; 0 means done."""

UsageError: type[Exception] = typer.BadParameter.__bases__[0]
"""The exception that typer raises for unknown commands and options; not public in all versions of typer."""

app = typer.Typer(
    name="cobevglue",
    help="Relative pose between vehicles and roadside units from commonly observed objects, without trusting GPS.",
    epilog="Exit codes: 0 done, 2 bad input or usage, 3 the alignment was refused.",
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _reflowed(text: str) -> str:
    """Join the lines of each paragraph, so that the help is wrapped at the width of the terminal."""
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in inspect.cleandoc(text).split("\n\n"))


for _command in (demo, align, simulate, train, evaluate, reproduce, bench, replay, node):
    app.command(help=_reflowed(_command.__doc__ or ""))(_command)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"cobevglue {cobevglue.__version__}")
        raise typer.Exit


@app.callback(invoke_without_command=True)
def _options(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(context.get_help())
        raise typer.Exit(BAD_INPUT)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program.

    Args:
        arguments: of the program, without its name; None for those of the command line.

    Returns:
        The exit code: 0 done, 2 bad input or usage, 3 the alignment was refused, 130 interrupted.
    """
    try:
        words = None if arguments is None else list(arguments)
        code = get_command(app).main(args=words, prog_name="cobevglue", standalone_mode=False)
    except InputError as error:
        print_note(f"error: {error}")
        return BAD_INPUT
    except UsageError as error:
        print_note(f"error: {_usage_message(error)}")
        return BAD_INPUT
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    if code == INTERRUPTED:
        print_note("interrupted")
    return code if isinstance(code, int) else 0


def _usage_message(error: Exception) -> str:
    """One line: the error, and the command that prints help."""
    message = " ".join(str(getattr(error, "format_message", error.__str__)()).split())
    if re.search(r"No such option: -\d", message):  # roadside units of data sets have negative ids
        message = f"{message.rstrip('.')}; write a path that begins with a dash as ./-1/…"
    context = getattr(error, "ctx", None)
    command = context.command_path if context is not None else "cobevglue"
    return f"{message.rstrip('.')}; see '{command} --help'"
