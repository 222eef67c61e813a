"""What others write does not command the terminal."""

from __future__ import annotations

import io
import logging
import logging.config
import subprocess
import sys
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from command_line import SMALL, here
from omegaconf import OmegaConf
from rich.console import Console
from rich.table import Table
from websockets.sync.server import ServerConnection, serve

from vla.config.compose import CONF
from vla.io.printable import escape, show
from vla.run import sentence

TITLE = "\x1b]0;evil\x07"  # sets the title of a terminal
SHOWN = r"\x1b]0;evil\x07"


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        (TITLE, SHOWN),
        ("a\r\x00\x7f\x9b2J", r"a\r\x00\x7f\x9b2J"),
        ("\u202egnp.exe\u2066\u2028", r"\u202egnp.exe\u2066\u2028"),
        ("\udce9", r"\udce9"),
        ("two\n\tlines", "two\n\tlines"),
        ("把红色方块放在垫子上\u3000ضع المكعب 🤖 é", "把红色方块放在垫子上\u3000ضع المكعب 🤖 é"),
    ],
)
def test_hidden_characters_become_visible_and_others_stay(text: str, shown: str) -> None:
    assert escape(text) == shown


def test_sentences_and_logs_of_a_run_are_printable() -> None:
    assert sentence(ValueError(f"no\n  {TITLE}")) == f"no {SHOWN}"
    assert sentence(OSError(2, "No such file", f"a\nerror: {TITLE}")) == f"a error: {SHOWN}: No such file"
    options: Any = OmegaConf.load(CONF / "config.yaml").hydra.job_logging.formatters.simple
    formatter = logging.config.DictConfigurator({}).configure_formatter(dict(options))
    assert formatter.format(logging.LogRecord("run", 0, "", 0, "from %s", (TITLE,), None)) == f"from {SHOWN}"


def test_tables_are_printable_and_keep_their_style(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr("rich._console", Console(file=out, force_terminal=True, color_system="standard"))
    table = Table(TITLE)
    table.add_row("[red]1[/red]")
    show(table)
    assert r"\x1b]0;evil" in out.getvalue() and "\x1b[31m1" in out.getvalue() and "\x1b]" not in out.getvalue()


def test_a_bug_shows_a_printable_traceback() -> None:
    program = "import vla.run as run\ndef bug(): raise KeyError(chr(27) + ']0;evil')\nrun._compose = bug\nrun.main()"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr.startswith("Traceback") and "\x1b" not in done.stderr
    assert done.stderr.endswith(r"KeyError: '\x1b]0;evil'" + "\n")


def test_a_servers_error_does_not_command_the_terminal_of_its_client(tmp_path: Path) -> None:
    def refuse(connection: ServerConnection) -> None:
        connection.send(f"first\n{TITLE} of the server")

    with serve(refuse, "127.0.0.1", 0) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        url = f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        done = here(tmp_path, *SMALL, "agent=remote", f"agent.url={url}", "recorder=none", "output=run", ok=False)
    assert (
        done.stderr == f"error: the policy server at {url} failed: {SHOWN} of the server\n" and TITLE not in done.stdout
    )
