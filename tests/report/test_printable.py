"""Text and sigmas as a terminal, a page and a table may have them."""

import math

import pytest

from uwblite.report.printable import sigma_text


@pytest.mark.parametrize(
    ("sigma", "digits", "text"),
    [
        (0.3551, 2, "0.36"), (0.0049, 2, "0.0049"), (0.00012, 3, "0.00012"), (12.0, 2, "12.00"), (0.0, 3, "0"),
        (1e-30, 3, "0.000000000"), (math.nan, 3, "?"), (math.inf, 3, "?"),
    ],
)  # fmt: skip
def test_a_sigma_shows_at_least_two_digits_of_itself(sigma, digits, text):
    assert sigma_text(sigma, digits) == text
