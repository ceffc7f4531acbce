"""A session: bytes resume the script, waits end in time, and what is no frame is always said."""

import pytest

from uwblite.drivers.devices import DEVICES, open_device
from uwblite.drivers.events import Corrupt, Note, Send, SetDtr
from uwblite.drivers.session import Driver, Session, Wait

NOISE = Corrupt("noise")


def note(name, text=""):
    return Note("info", name, str(text))


class Letters:
    """Each byte is an event, a question mark is none of the protocol."""

    def feed(self, data, stamp):
        return [NOISE if letter == "?" else letter for letter in data.decode()]

    def reset(self):
        pass


class Listener(Driver):
    """Takes what a device says unasked."""

    def take(self, event):
        return [note(event, self.now)]


class Asker(Driver):
    """Asks twice at most, half a second each, for an x; then ends."""

    def script(self):
        found = yield from self.ask(b"x?", lambda event: event == "x", 0.5, tries=2)
        yield note("found", found)


def test_what_is_no_frame_is_said_and_not_taken():
    session = Session(Listener(Letters(), "letters"))
    assert session.start(0.0) == []
    assert session.feed(b"a?b", 2.0) == [note("a", 2.0), NOISE, note("b", 2.0)]
    assert session.deadline() is None
    assert session.tick(99.0) == []


def test_a_script_that_waits_sees_noise_too_and_goes_on_waiting():
    session = Session(Asker(Letters(), "letters"))
    assert session.start(1.0) == [Send(b"x?")]
    assert session.feed(b"?y", 1.2) == [NOISE]
    assert session.feed(b"xz", 1.3) == [note("found", "x")]
    assert session.feed(b"?x", 1.4) == [NOISE]
    assert session.deadline() is None


@pytest.mark.parametrize("start", [0.0, 7.0])
def test_a_question_is_asked_again_when_its_time_is_over_and_given_up(start):
    session = Session(Asker(Letters(), "letters"))
    session.start(start)
    assert session.deadline() == start + 0.5
    assert session.tick(start + 0.49) == []
    assert session.tick(start + 0.5) == [Send(b"x?")]
    assert session.deadline() == start + 1.0
    assert session.tick(start + 1.2) == [note("found", None)]
    assert session.tick(start + 9.0) == []


def test_a_note_is_said_once():
    driver = Listener(Letters(), "letters")
    assert driver.say_once(note("a", 1), note("b", 2)) == [note("a", 1), note("b", 2)]
    assert driver.say_once(note("a", 3), note("c", 4)) == [note("c", 4)]


def test_what_comes_while_a_script_sleeps_is_kept():
    class Sleeper(Driver):
        def script(self):
            yield note("heard", "".join((yield from self.sleep(1.0))))
            yield Wait(None)

    session = Session(Sleeper(Letters(), "letters"))
    session.start(0.0)
    assert session.feed(b"ab", 0.5) == []
    assert session.tick(1.0) == [note("heard", "ab")]


def test_the_last_thing_that_was_understood_has_a_time():
    session = Session(Listener(Letters(), "letters"))
    session.start(1.0)
    assert session.last_event < 0.0
    session.feed(b"a", 2.0)
    session.feed(b"?", 3.0)
    assert session.last_event == 2.0


LAST_WORDS = {
    "create2": [Send(b"\x96\x00")],
    "scip": [Send(b"QT\n")],
    "ydlidar-x2": [SetDtr(False)],
    "ydlidar-x4": [Send(b"\xa5\x65"), SetDtr(False)],
    "rplidar": [Send(b"\xa5\x25"), Send(b"\xa5\xf0\x02\x00\x00\x57"), SetDtr(True)],
    "lds01": [Send(b"e")],
}
"""What makes a device fall quiet and its motor stand, by its manual."""


@pytest.mark.parametrize("kind", DEVICES.values(), ids=DEVICES)
def test_a_device_that_is_let_go_falls_quiet_and_its_motor_stands(kind):
    session, _ = open_device(kind.sensor, f"{kind.name}:/dev/none")
    session.start(1.0)
    assert session.stop() == LAST_WORDS.get(kind.name, [])
