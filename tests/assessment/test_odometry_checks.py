"""The width of a path by its length; figures of the wheels and what is said of them."""

import numpy as np
import pytest
from helpers.planted import chain
from scipy.special import j0

from uwblite import se2
from uwblite.assessment.odometry_figures import check_odometry, odometry_figures, straightness
from uwblite.sensor_log import Odometry


@pytest.mark.parametrize("turn", [0.0, 0.4, 2.0])
def test_a_path_is_as_wide_as_its_principal_axes_are_long(turn):
    angle = np.linspace(0.0, 2.0 * np.pi, 100, endpoint=False)
    ellipse = np.column_stack([3.0 * np.cos(angle), 1.2 * np.sin(angle)])
    assert straightness(se2.rotate(turn, ellipse)) == pytest.approx(0.4)
    assert straightness(se2.rotate(turn, ellipse * [1.0, 0.0])) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("count", [0, 1, 2, 5])
def test_a_robot_that_stands_has_no_width(count):
    assert straightness(np.ones((count, 2))) == 0.0


def checked(poses, rate):
    odometry = Odometry(np.arange(len(poses)) / rate, poses)
    figures = odometry_figures(odometry)
    return figures, list(check_odometry(odometry, figures))


@pytest.mark.parametrize(("rate", "slow"), [(4.9, True), (5.1, False)])
def test_figures_of_a_square(rate, slow):
    """Four sides of five steps of 0.1 m; after each side a step that turns on the spot and one that rests."""
    steps = np.tile(np.array([[0.1, 0.0, 0.0]] * 5 + [[0.0, 0.0, np.pi / 2], [0.0, 0.0, 0.0]]), (4, 1))
    figures, found = checked(chain(np.zeros(3), steps), rate)
    assert figures["path m"] == 2.0
    assert figures["turned rad"] == pytest.approx(2.0 * np.pi, abs=1e-3)
    assert figures["speed m/s"] == pytest.approx(0.1 * rate, abs=1e-4)
    assert figures["width of the path by its length"] == pytest.approx(1.0, abs=0.05)
    assert ["readings a second" in f.text for f in found] == ([True] if slow else [])


@pytest.mark.parametrize(("swing", "said"), [(0.5, False), (0.6, True)])
def test_a_robot_that_moves_across_its_heading_is_named(swing, said):
    """A heading that swings about the tangent of a circle: the mean of exp(2i swing sin) is Bessel's J0(2 swing)."""
    angle = np.linspace(0.0, 4.0 * np.pi, 800)
    there = np.column_stack([3.0 * np.cos(angle), 3.0 * np.sin(angle)])
    off = 0.5 * np.pi + swing * np.sin(3.0 * angle)
    figures, found = checked(np.column_stack([there, se2.wrap_angle(angle + off)]), 20.0)
    assert figures["heading"]["agreement with the motion"] == pytest.approx(j0(2.0 * swing), abs=0.02)
    assert ["across its heading" in f.text for f in found] == ([True] if said else [])


def test_three_places_have_a_width_and_two_have_none():
    assert straightness(np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])) == pytest.approx(1.0)
    assert straightness(np.array([[0.0, 0.0], [1.0, 3.0]])) == 0.0


def test_a_robot_that_never_moves_has_no_speed():
    figures, _ = checked(np.ones((50, 3)), 10.0)
    assert (figures["speed m/s"], figures["path m"], figures["turned rad"]) == (0.0, 0.0, 0.0)


def test_figures_are_rounded_to_what_they_are_worth():
    poses = np.column_stack([0.0123456 * np.arange(50), 0.0003 * np.sin(np.arange(50)), 0.0123456 * np.arange(50)])
    figures, _ = checked(poses, 10.0)
    for name, digits in (("path m", 3), ("turned rad", 3), ("speed m/s", 4), ("width of the path by its length", 4)):
        assert figures[name] == round(figures[name], digits) != round(figures[name], digits - 1)


def test_the_usual_speed_is_that_of_a_robot_that_drives():
    """It stands for two thirds of the time, and one reading has the stamp of the one before."""
    poses = np.zeros((91, 3))
    poses[61:, 0] = 0.05 * np.arange(1, 31)
    stamps = 0.1 * np.arange(91)
    stamps[80] = stamps[79]
    assert odometry_figures(Odometry(stamps, poses))["speed m/s"] == pytest.approx(0.5, abs=1e-3)
