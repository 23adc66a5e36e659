"""The ``steadypose`` command: dispatches to subcommands, with one line of help for each.

A subcommand is a typed function with a docstring. Its module is imported only when the subcommand is called, so that
`steadypose --help` and subcommands without torch never wait for torch.
"""

import importlib
import inspect
import os
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, nullcontext, redirect_stdout, suppress
from importlib.metadata import version
from io import StringIO, TextIOWrapper
from typing import Annotated, Any, get_type_hints

from steadypose.nodes.extras import extra_of, how_to_install, install_command, upgrade_and_uninstall
from steadypose.prior.settings import nearest

COMMANDS = {
    "run": ("run", "clean poses live, from a camera, a tracker or a recording"),
    "node": ("node", "run one node of `run`, for another machine or a supervisor"),
    "clean": ("clean", "clean a recording, .npz or .csv offline, as `run` does live"),
    "retarget": ("export", "convert a person's motion to a robot's, by its URDF"),
    "fit": ("fit", "fit a motion to a whole recording; slower than `clean`"),
    "complete": ("complete", "fill in gaps between key frames and missing joints, offline"),
    "export": ("export", "write cleaned motion as BVH, GLB, VRMA, CSV or TRC"),
    "echo": ("inspect", "print the messages of a topic or recording"),
    "hz": ("inspect", "measure the rate of a topic or recording"),
    "info": ("info", "describe a recording, a file of poses or a topic"),
    "repair": ("small", "write the readable part of a damaged recording to a new one"),
    "plot": ("small", "plot a recording as an image or a video"),
    "prepare": ("prepare", "convert motion capture to training data"),
    "train": ("train", "train a model of the prior"),
    "evaluate": ("steadypose.benchmarks.evaluate", "measure accuracy and speed beside tuned baselines"),
    "simulate": ("small", "simulate recordings of a depth camera, with ground truth"),
    "calibrate": ("calibrate", "calibrate a camera's lens and pose, or a sensor's own error"),
    "doctor": ("doctor", "check this machine: what is missing, and how to get it"),
    "install-service": ("install_service", "run a launch file at every boot, under systemd"),
    "keys": ("small", "make CurveZMQ keys, for messages between machines"),
}
"""Module and one-line help of each command. Modules without a dot in their name are in `nodes.commands`."""
TOPICS = ("upgrade", "uninstall")  # what `help` explains beside the commands
USAGE_ERROR = 2  # exit status of a request that cannot succeed and should not be retried
INTERRUPTED = 130


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    if isinstance(sys.stdout, TextIOWrapper):  # a file's name may have characters that its encoding lacks
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        status = _main(sys.argv[1:] if arguments is None else arguments)
        sys.stdout.flush()
    except BrokenPipeError:
        # a reader such as `head` closed the pipe; redirect stdout so that Python's flush at exit does not fail
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return status


def _main(arguments: list[str]) -> int:
    if len(arguments) > 1 and arguments[0] == "help":
        if (topic := arguments[1]) in TOPICS:
            print(upgrade_and_uninstall())
            return 0
        if topic not in COMMANDS:
            return _unknown(f"no help on {topic!r}", topic, (*TOPICS, *COMMANDS))
        arguments = [topic, "--help"]
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage())
        return 0
    if arguments[0] == "--version":
        print(version("steadypose"))
        return 0
    name = arguments[0]
    if name == "add":  # of the checkout's ./steadypose; somebody who installed by pip tries it here
        print(f"steadypose: to add an extra: {install_command((arguments[1:] or ['EXTRA'])[0])}", file=sys.stderr)
        return USAGE_ERROR
    if name not in COMMANDS:
        return _unknown(f"no command {name!r}", name, COMMANDS)
    if name == "node":  # OpenBLAS creates its threads (9 MB) when it is loaded, before `one_thread` could prevent it
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        status = _run(name, arguments[1:])
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as error:
        if (message := message_of(error)) is None:
            raise
        from steadypose.nodes.settings import printable  # imports numpy

        print(f"steadypose {name}: {printable(message)}", file=sys.stderr)
        return USAGE_ERROR
    return status if isinstance(status, int) else 0


def _unknown(what: str, name: str, known: Iterable[str]) -> int:
    print(f"steadypose: {what}{nearest(name, known) or ': there are ' + ', '.join(known)}", file=sys.stderr)
    return USAGE_ERROR


def _run(name: str, arguments: list[str]) -> object:
    place, _ = COMMANDS[name]
    module = importlib.import_module(place if "." in place else f"steadypose.nodes.commands.{place}")
    command = getattr(module, name.replace("-", "_"))
    if name == "node":  # parses its arguments itself, because tyro would cost every node 0.1 s and 6 MB
        return command(arguments)
    import tyro

    asks = not {"-h", "--help"}.isdisjoint(arguments)
    if asks:
        _prepare_help(vars(module).values())
    with _wrapped() if asks else nullcontext():
        return tyro.cli(
            command,
            prog=f"steadypose {name}",
            args=arguments,
            config=(tyro.conf.PositionalRequiredArgs, tyro.conf.UseAppendAction, tyro.conf.FlagCreatePairsOff),
        )


def _prepare_help(documented: Iterable[Any]) -> None:
    """Adapt docstrings to tyro, which keeps the source's line breaks: join each argument's description into one line.

    "(default: None)" is left out, because descriptions say what happens without the argument.
    """
    from tyro.conf import arg

    for thing in documented:
        doc = getattr(thing, "__doc__", None) or ""
        if callable(thing) and "\n    Args:\n" in doc:
            described, heading, listed = doc.partition("\n    Args:\n")
            described = re.sub(r"(?m)^((?: {4})?\S.*)\n {4}(?=[^\w\s])", r"\1 ", described)
            thing.__doc__ = described + heading + re.sub(r"\n {12}(?=\S)", " ", listed)
            with suppress(NameError):  # of a class that is imported, and annotated for type checkers alone
                hints = get_type_hints(thing, include_extras=True)
                for name, parameter in inspect.signature(thing).parameters.items():
                    if parameter.default is None and name in hints:
                        thing.__annotations__[name] = Annotated[hints[name], arg(help_behavior_hint="")]


@contextmanager
def _wrapped() -> Iterator[None]:
    """Wrap the paragraphs of a help text at the terminal's width."""
    text = StringIO()
    text.isatty = sys.stdout.isatty  # type: ignore[method-assign]  (tyro decides by it whether to use colours)
    try:
        with redirect_stdout(text):
            yield
    finally:
        width = shutil.get_terminal_size().columns
        for line in text.getvalue().splitlines():
            print(line if line[:1] in (" ", "│", "╭", "╰", "") else textwrap.fill(line, width, break_on_hyphens=False))


def message_of(error: Exception) -> str | None:
    """What to print for an error that is steadypose's own, an OSError or a missing extra; None for a bug."""
    if isinstance(error, ModuleNotFoundError):
        if error.name == "steadypose.benchmarks":
            return "the studies are not installed: expected a checkout of the project"
        missing = (error.name or "").partition(".")[0]
        extra = extra_of(missing)
        return how_to_install([missing], extra) if extra else None
    own = isinstance(error, OSError) or type(error).__module__.startswith("steadypose.")
    return str(error) if own and not isinstance(error, BrokenPipeError) else None


def usage() -> str:
    """The help of ``steadypose`` itself."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name:<{width}}  {what}" for name, (_, what) in COMMANDS.items()]
    return "\n".join(
        (
            "steadypose: clean, world-space human pose from any noisy 3D skeleton source\n",
            "commands:",
            *lines,
            "\nOptions: `steadypose COMMAND --help`. `steadypose run` plays a bundled stream.",
            "To upgrade: `steadypose help upgrade`. To remove: `steadypose help uninstall`.",
        )
    )


if __name__ == "__main__":
    sys.exit(main())
