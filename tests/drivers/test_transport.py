"""Ports that do not open: the words that say how to mend that."""

import pytest

from uwblite.drivers import transport
from uwblite.drivers.transport import _explain


@pytest.mark.parametrize(("url", "error", "words"), [
    ("socket://10.0.0.9:4000", OSError("timed out"), "socket://10.0.0.9:4000: cannot open (timed out)"),
    ("{own}", OSError(13, "denied"), "{own}: no permission; run `sudo usermod -aG dialout $USER`, log out and in again"),
    ("{own}", OSError("Permission denied: /dev/x"), "{own}: no permission; run `sudo"),
    ("{own}", OSError(16, "busy"), "{own}: another program has it open (ModemManager"),
    ("{own}", OSError("Could not exclusively lock port"), "{own}: another program has it open (ModemManager"),
    ("/dev/null", OSError("Could not configure port: (25, 'ioctl')"), "/dev/null: not a serial port"),
    ("{own}", OSError("Could not configure port"), "{own}: cannot open (Could not configure port)"),
])  # fmt: skip
def test_a_port_that_does_not_open_is_explained(tmp_path, url, error, words):
    own = tmp_path / "port"
    own.touch()
    assert _explain(url.format(own=own), error).startswith(words.format(own=own))


@pytest.mark.parametrize("name", ["clock", "Permission", "configure port"])
def test_words_of_a_ports_own_path_explain_nothing(tmp_path, name):
    own = tmp_path / name
    own.touch()
    text = f"could not open port {own}: input/output error"
    assert _explain(str(own), OSError(5, text)).startswith(f"{own}: cannot open ([Errno 5] could not open")


def test_a_port_that_is_not_there_names_those_that_are(tmp_path, monkeypatch):
    monkeypatch.setattr(transport, "BY_ID", tmp_path / "none")
    assert _explain(f"{tmp_path}/ttyUSB7", OSError("no such file")).endswith("ttyUSB7: no such port; nothing is plugged in")
    for name in ("usb-b", "usb-a"):
        (tmp_path / name).touch()
    monkeypatch.setattr(transport, "BY_ID", tmp_path)
    assert _explain(f"{tmp_path}/ttyUSB7", OSError("no such file")).endswith(f"in {tmp_path} there are: usb-a, usb-b")
