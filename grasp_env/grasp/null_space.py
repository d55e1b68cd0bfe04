"""A basis of internal forces that is continuous in the contacts; that of an SVD is not."""

from __future__ import annotations

import numpy as np

from grasp_env.errors import InvalidInputError
from grasp_env.grasp.grasp import Grasp, as_grasp
from grasp_env.inputs import ranges
from grasp_env.inputs.arguments import Array, as_array


def null_space_basis(grasp: Grasp, reference: Array | None = None) -> Array:
    """Return orthonormal internal forces of `grasp`, as close as possible to `reference`.

    The reference directions are projected on the null space of G and orthonormalised by their polar
    factor B (B^T B)^-1/2. It is a smooth function of the contacts, also where the tangents of
    `contact_frames` switch axes, as long as the projection has full rank and `null_dimension` does
    not change. The forces balance without the torsions of soft contacts.

    Args:
        grasp: the contacts.
        reference: (3N, null_dimension) object-frame vectors stacked contact by contact, the
            `reference_basis` of a nominal grasp; None: that of `grasp` itself.

    Returns:
        (3N, null_dimension) contact-frame forces (normal, o, t), stacked; G @ basis = 0, columns
        orthonormal. The tangential rows of frictionless contacts are zero.

    Raises:
        InvalidInputError: a reference of another shape, or one whose projection loses rank.
    """
    if as_grasp(grasp).null_dimension == 0:
        return np.zeros((3 * grasp.n_contacts, 0))
    if reference is None:
        reference = reference_basis(grasp)
    else:
        shape = (3 * as_grasp(grasp).n_contacts, grasp.null_dimension)
        reference = as_array(reference, shape, "reference", ranges.SIZE)
    return _internal(grasp, _rotate(grasp, reference))


def reference_basis(grasp: Grasp) -> Array:
    """Return orthonormal object-frame internal forces (3N, null_dimension), for nearby grasps.

    The columns come from squeezes along the lines between pairs of contacts (the virtual linkage of
    Williams and Khatib, 1993). If these are not a basis of the null space (coplanar or frictionless
    contacts, N > 4), an orthonormal basis by the SVD of G replaces them.
    """
    count = as_grasp(grasp).n_contacts
    dimension = grasp.null_dimension
    if dimension == 0:
        return np.zeros((3 * count, 0))
    sent = grasp.models.transmitted.reshape(-1)
    pairs = [(i, j) for i in range(count) for j in range(i + 1, count)]
    squeezes = np.zeros((3 * count, len(pairs)))
    for column, (i, j) in enumerate(pairs):
        line = grasp.positions[j] - grasp.positions[i]
        line = line / max(float(np.linalg.norm(line)), 1e-12)
        squeezes[3 * i : 3 * i + 3, column] = line
        squeezes[3 * j : 3 * j + 3, column] = -line
    if (
        sent.all()
        and len(pairs) == dimension
        and np.linalg.svd(squeezes, compute_uv=False)[-1] > 1e-2
    ):
        return _polar(squeezes)
    basis = np.zeros((3 * count, dimension))
    basis[sent] = np.linalg.svd(grasp.matrix[:, sent])[2][sent.sum() - dimension :].T
    in_object = _rotate(grasp, _internal(grasp, basis), back=True)
    in_object *= np.sign(in_object[np.abs(in_object).argmax(axis=0), np.arange(dimension)])
    return in_object


def _internal(grasp: Grasp, forces: Array) -> Array:
    """Project contact-frame `forces` (3N, K) on the internal forces; return the polar factor."""
    sent = grasp.models.transmitted.reshape(-1)
    # the right singular vectors of what G transmits, without those of zero singular values, span
    # what is not internal: the pseudoinverse would not do, since it may need torsions
    rows = np.linalg.svd(grasp.unit_frame @ (grasp.matrix * sent), full_matrices=False)[2]
    rows = rows[: sent.sum() - grasp.null_dimension] * sent
    candidate = forces * sent[:, None]
    basis = _polar(candidate - rows.T @ (rows @ candidate))
    # a second projection removes the rounding error of G @ basis
    return basis - rows.T @ (rows @ basis)


def _rotate(grasp: Grasp, stacked: Array, back: bool = False) -> Array:
    """Rotate columns from the object frame to the contact frames, or `back`."""
    blocks = stacked.reshape(grasp.n_contacts, 3, -1)
    rule = "nij,njk->nik" if back else "nji,njk->nik"
    return np.einsum(rule, grasp.frames, blocks).reshape(stacked.shape)


def _polar(columns: Array) -> Array:
    """Return the polar factor of the columns: the closest orthonormal ones."""
    values, vectors = np.linalg.eigh(columns.T @ columns)
    if not values.min(initial=1.0) > 1e-14 * values.max(initial=1.0):
        raise InvalidInputError(
            f"reference must have {columns.shape[1]} independent directions that the contacts leave internal: give others"
        )
    return columns @ ((vectors / np.sqrt(values)) @ vectors.T)
