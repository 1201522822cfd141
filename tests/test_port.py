"""`FlatPort`: what it refuses, and the published parameter row."""

import numpy as np
import pytest

from uwsfm import FlatPort, InputError


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"normal": (0, 0, -1)}, "flipped"),
        ({"normal": (1, 0, 0)}, "positive z"),
        ({"normal": (0, 0, 2)}, "unit"),
        ({"normal": (0, 0, 0)}, "unit"),
        ({"normal": (0, 0, 1 + 1e-5)}, "unit"),
        ({"normal": (0, np.nan, 1)}, "finite"),
        ({"normal": (0, 1)}, "3 finite"),
        ({"normal": "up"}, "3 finite"),
        ({"distance": -1e-12}, "negative"),
        ({"distance": np.inf}, "finite"),
        ({"distance": "2 cm"}, "number"),
        ({"thickness": -0.01}, "negative"),
        ({"thickness": None}, "number"),
        ({"n_glass": 0.9}, "refractive index"),
        ({"n_water": 0.0}, "refractive index"),
        ({"n_water": np.nan}, "finite"),
        ({"n_air": 1333.0}, "refractive index"),
    ],
)
def test_unphysical_ports_are_refused_by_name(values, word):
    with pytest.raises(InputError, match=word) as error:
        FlatPort(**values)
    assert next(iter(values)) in str(error.value)


def test_parameter_row_has_the_published_order_and_comes_back():
    port = FlatPort((0.6, 0.0, 0.8), 0.02, 0.01, 1.5, 1.333, 1.0003)
    np.testing.assert_array_equal(
        port.params, [0.6, 0.0, 0.8, 0.02, 0.01, 1.0003, 1.5, 1.333]
    )
    assert FlatPort.from_params(port.params) == port
    with pytest.raises(InputError, match="8 numbers"):
        FlatPort.from_params(port.params[:7])


def test_normal_is_made_unit_without_touching_the_array_given():
    given = np.array([0.0, 0.0, 1.0 + 5e-7])
    given.setflags(write=False)
    port = FlatPort(normal=given)
    assert port.normal == (0.0, 0.0, 1.0)
    assert given[2] == 1.0 + 5e-7
