import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import splu

from uwblite.errors import SolverError
from uwblite.graph.selected_inverse import selected_inverse

OPTIONS = {"SymmetricMode": True, "Equil": False}


def grid(width, height, seed=0):
    """Return a random positive definite matrix with the pattern of a grid."""
    rng = np.random.default_rng(seed)
    number = np.arange(width * height).reshape(width, height)
    a = np.concatenate([number[1:].ravel(), number[:, 1:].ravel()])
    b = np.concatenate([number[:-1].ravel(), number[:, :-1].ravel()])
    weight = rng.uniform(0.5, 1.5, len(a)) * rng.choice([-1.0, 1.0], len(a))
    upper = sparse.coo_matrix((weight, (b, a)), shape=(number.size, number.size))
    return (upper + upper.T + sparse.diags(rng.uniform(5.0, 6.0, number.size))).tocsc()


@pytest.mark.parametrize("order", ["NATURAL", "MMD_AT_PLUS_A"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 40), (7, 7), (3, 100), (20, 25)])
def test_entries_equal_the_dense_inverse(shape, order):
    matrix = grid(*shape)
    factor = splu(matrix, permc_spec=order, diag_pivot_thresh=0.0, options=OPTIONS)
    rows, columns = matrix.nonzero()
    found = selected_inverse(factor, rows, columns)
    np.testing.assert_allclose(found, np.linalg.inv(matrix.toarray())[rows, columns], atol=1e-13)


def test_separate_parts_are_inverted_separately():
    matrix = sparse.block_diag([grid(5, 20), grid(1, 1), grid(30, 2)]).tocsc()
    factor = splu(matrix, permc_spec="NATURAL", diag_pivot_thresh=0.0, options=OPTIONS)
    each = np.arange(matrix.shape[0])
    np.testing.assert_allclose(selected_inverse(factor, each, each), np.diag(np.linalg.inv(matrix.toarray())), atol=1e-13)


def test_pivoted_factors_are_refused():
    matrix = sparse.csc_matrix(np.array([[0.0, 1.0], [1.0, 0.0]]))
    factor = splu(matrix, permc_spec="NATURAL")
    with pytest.raises(SolverError, match="positive definite"):
        selected_inverse(factor, np.array([0]), np.array([0]))
