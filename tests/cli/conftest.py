"""How much a command writes is a state of the process: no test hands its own to the next."""

import pytest

from uwblite.cli import console


@pytest.fixture(autouse=True)
def _plain_output():
    console.set_up()
