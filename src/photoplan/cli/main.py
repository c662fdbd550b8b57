"""The command `photoplan`: errors and exit codes; its commands are rows of `photoplan.cli.table`."""

from __future__ import annotations

import atexit
import errno
import gc
import os
import sys
import threading
import warnings
from collections.abc import Sequence

import click

from photoplan.cli.interrupt import CODE, catch_interrupts, stop_children
from photoplan.cli.lazy import LazyGroup
from photoplan.cli.output import printable
from photoplan.cli.table import VERBS, command_at
from photoplan.errors import PhotoplanError, PhotoplanWarning, ResourceError


@click.group(
    cls=LazyGroup,
    verbs=VERBS,
)
@click.version_option(package_name="photoplan")
def photoplan() -> None:
    """Make orthophotos, mosaics, terrain models and views from images, with their accuracy.

    The usual order is: init → (fiducials → tie → adjust) → check → ortho. Results are printed on stdout, messages
    and progress on stderr.

    Exit codes: 0 done, 1 failed, 2 wrong use, 3 bad input, 4 finished, but tiles or images failed, 5 out of disk or
    memory, 130 interrupted.
    """


def main() -> None:
    """Entry point of the command."""
    catch_interrupts()
    start()
    _leave(run())


def start() -> None:
    """Settings of a process that runs commands; before anything large is imported."""
    # The 100,000 objects of imports stay: to look through them for garbage again and again is 0.1 CPU s of each start.
    gc.set_threshold(200_000)
    # The fits of commands are small: waking the threads of linear algebra costs more than they save, and results would
    # depend on their number. Here, since it is read when NumPy is loaded.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Photos have no georeference. Here and not only where files are opened, since a filter there holds for one thread.
    warnings.filterwarnings("ignore", "Dataset has no geotransform")
    # A user can do nothing with a word of NumPy on an overflow: what comes of it is judged by its meaning.
    warnings.filterwarnings("ignore", "(overflow|underflow|divide by zero|invalid value) encountered", RuntimeWarning)
    warnings.filterwarnings("ignore", "(Mean of empty|All-NaN|Degrees of freedom)", RuntimeWarning)
    warnings.formatwarning = _warning
    # Of a damaged file rasterio cannot decode what GDAL says: two tracebacks each time. Ours do not come this way.
    usual, unraisable = sys.excepthook, sys.unraisablehook
    sys.excepthook = lambda kind, error, where: None if _undecoded(error) else usual(kind, error, where)
    sys.unraisablehook = lambda what: None if _undecoded(what.exc_value) else unraisable(what)


def _undecoded(error: BaseException | None) -> bool:
    return isinstance(error, UnicodeDecodeError)


def run(arguments: Sequence[str] | None = None) -> int:
    """Run a verb; every error becomes a message on stderr and an exit code."""
    try:
        code = photoplan.main(arguments, prog_name="photoplan", standalone_mode=False, obj=command_at)
    except (click.exceptions.Abort, KeyboardInterrupt):
        stop_children()
        return _say("interrupted; the same command continues, or begins anew where nothing is kept", CODE)
    except click.ClickException as error:
        error.show()
        return 2
    except PhotoplanError as error:
        return _say(str(error), error.exit_code)
    except MemoryError:
        return _say("out of memory; give fewer --workers or less --memory", ResourceError.exit_code)
    except OSError as error:
        return _say(_os_message(error), 5 if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG) else 1)
    except Exception as error:
        if os.environ.get("PHOTOPLAN_TRACEBACK"):
            raise
        name = type(error).__name__
        return _say(f"{name}: {error} — a fault of photoplan; PHOTOPLAN_TRACEBACK=1 shows where", 1)
    return code if isinstance(code, int) else 0


def _say(message: str, code: int) -> int:
    click.echo(printable(f"photoplan: {message}"), err=True)
    return code


def _warning(
    message: Warning | str, category: type[Warning], filename: str, lineno: int, line: str | None = None
) -> str:
    """Our own warnings as messages, others as Python shows them."""
    if issubclass(category, PhotoplanWarning):
        return printable(f"photoplan: {message}\n")
    return f"{filename}:{lineno}: {category.__name__}: {message}\n"


def _os_message(error: OSError) -> str:
    where = f"{error.filename}: " if error.filename else ""
    return f"{where}{error.strerror or error}"


def _leave(code: int) -> None:
    """Flush and exit; a reader that closed its end of a pipe (`| head`) is no error."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if code == 0 and all(thread.daemon or thread is threading.main_thread() for thread in threading.enumerate()):
        # All is written and closed; to take down what was imported, object by object, is 0.15 CPU s.
        atexit._run_exitfuncs()
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
