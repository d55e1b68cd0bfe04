"""A basis of internal forces that moves continuously with the contacts (an SVD's basis jumps)."""

from __future__ import annotations

import numpy as np

from grasp_env import ranges
from grasp_env._check import Array, as_array
from grasp_env.errors import InvalidInputError
from grasp_env.grasp.grasp import Grasp, as_grasp


def null_space_basis(grasp: Grasp, reference: Array | None = None) -> Array:
    """Orthonormal internal forces of `grasp`, as close as possible to `reference`.

    The reference directions are projected on the null space of G and orthonormalised by their polar factor
    B (B^T B)^-1/2, which is a smooth function of the contacts wherever the projection keeps full rank. Everything
    happens in object-frame vectors, so that it stays smooth where the tangents of `contact_frames` switch axes.

    Args:
        grasp: the grasp.
        reference: (3N, 3N - 6) object-frame vectors stacked contact by contact, e.g. `reference_basis` of a
            nominal grasp. None: the reference basis of `grasp` itself.

    Returns:
        (3N, 3N - 6) contact-frame forces (normal, o, t) stacked; G @ basis = 0, columns orthonormal.

    Raises:
        InvalidInputError: a reference of another shape, or one that the contacts do not leave internal.

    Example:
        >>> from grasp_env.grasp import presets
        >>> grasp = presets.paper_cuboid()
        >>> basis = null_space_basis(grasp)
        >>> basis.shape, bool(abs(grasp.matrix @ basis).max() < 1e-12)
        ((12, 6), True)
    """
    if reference is None:
        reference = reference_basis(grasp)
    else:
        shape = (3 * as_grasp(grasp).n_contacts, grasp.null_dimension)
        reference = as_array(reference, shape, "reference", ranges.SIZE)
    candidate = _rotate(grasp, reference)
    candidate = candidate - grasp.pseudoinverse @ (grasp.matrix @ candidate)
    basis = _polar(candidate)
    # a second projection takes away what rounding left of G @ basis
    return basis - grasp.pseudoinverse @ (grasp.matrix @ basis)


def reference_basis(grasp: Grasp) -> Array:
    """Object-frame internal forces to be used as `reference`: (3N, 3N - 6), orthonormal.

    Squeezes along the lines between contact pairs (the virtual linkage of Williams and Khatib, 1993) give each
    column a meaning; where they do not span the null space (coplanar contacts, N > 4) an orthonormal basis of the
    whole null space, aligned with as many of them as there are, takes their place.

    Args:
        grasp: the grasp, whose columns they are; grasps nearby take them as `null_space_basis(nearby, reference)`.

    Example:
        >>> from grasp_env.grasp import presets
        >>> reference_basis(presets.tripod()).shape
        (9, 3)
    """
    count, dimension = as_grasp(grasp).n_contacts, grasp.null_dimension
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    squeezes = np.zeros((3 * count, len(pairs)))
    for column, (i, j) in enumerate(pairs):
        line = grasp.positions[j] - grasp.positions[i]
        line = line / max(float(np.linalg.norm(line)), 1e-12)
        squeezes[3 * i : 3 * i + 3, column] = line
        squeezes[3 * j : 3 * j + 3, column] = -line
    if len(pairs) == dimension and np.linalg.svd(squeezes, compute_uv=False)[-1] > 1e-2:
        return _polar(squeezes)
    in_object = _rotate(grasp, np.linalg.svd(grasp.matrix)[2][6:].T, back=True)
    in_object *= np.sign(in_object[np.abs(in_object).argmax(axis=0), np.arange(dimension)])
    return in_object


def _rotate(grasp: Grasp, stacked: Array, back: bool = False) -> Array:
    """Object-frame columns -> contact-frame columns (`back`: the other way)."""
    blocks = stacked.reshape(grasp.n_contacts, 3, -1)
    rule = "nij,njk->nik" if back else "nji,njk->nik"
    return np.einsum(rule, grasp.frames, blocks).reshape(stacked.shape)


def _polar(columns: Array) -> Array:
    values, vectors = np.linalg.eigh(columns.T @ columns)
    if not values.min(initial=1.0) > 1e-14 * values.max(initial=1.0):
        raise InvalidInputError(
            "reference must have 3N - 6 independent directions that the contacts leave internal: give others"
        )
    return columns @ ((vectors / np.sqrt(values)) @ vectors.T)
