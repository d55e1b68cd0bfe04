"""The compiled core; use `grasp_env.core`."""

from collections.abc import Sequence
import enum
from typing import Annotated, Any, overload

import numpy
import numpy as np
import numpy.typing
from numpy.typing import NDArray


def build_info() -> dict[str, str]:
    """
    Version, compiler, instruction set, build type, target processor and flags of this module.
    """

def record_fields() -> dict[str, int]:
    """
    Return the offsets of a solution's fields in its row; from `force` on: 3N force, 3N initial force, N torsion.
    """

def codes() -> dict[str, int]:
    """Return the outcomes of a solve by name."""

def codes_with_a_force() -> tuple[int, ...]:
    """Return the codes of the rows that contain a force."""

def record_size(contacts: int) -> int:
    """Return the number of values in a row of N contacts."""

class Solution:
    """The data of a solution; see `grasp_env.force.ForceSolution`."""

    _record: NDArray[np.float64]
    _names: Any
    objective_trace: NDArray[np.float64]
    def __init__(
        self, record: NDArray[np.float64], names: Any, objective_trace: NDArray[np.float64] = ...
    ) -> None: ...
    @property
    def n_contacts(self) -> int: ...
    @property
    def code(self) -> int: ...
    @property
    def has_force(self) -> bool: ...
    @property
    def iterations(self) -> int: ...
    @property
    def trials(self) -> int: ...
    @property
    def objective(self) -> float: ...
    @property
    def lower_bound(self) -> float: ...
    @property
    def equilibrium_residual(self) -> float: ...
    @property
    def cone_margin(self) -> float: ...
    @property
    def limit_excess(self) -> float: ...
    @property
    def optimality_gap(self) -> float: ...
    @property
    def start_replaced(self) -> bool: ...
    def __bool__(self) -> bool: ...
    @property
    def wrench(self) -> NDArray[np.float64]: ...
    @property
    def wrench_with_preload(self) -> NDArray[np.float64]: ...
    @property
    def friction_used(self) -> NDArray[np.float64]: ...
    @property
    def multipliers(self) -> NDArray[np.float64]: ...
    @property
    def force(self) -> NDArray[np.float64]: ...
    @property
    def initial_force(self) -> NDArray[np.float64]: ...
    @property
    def torsion(self) -> NDArray[np.float64]: ...
    @property
    def frames(self) -> NDArray[np.float64]: ...
    @property
    def object_force(self) -> NDArray[np.float64]: ...
    @property
    def torques(self) -> NDArray[np.float64]: ...
    @property
    def limit_multipliers(self) -> NDArray[np.float64]: ...

TANGENT_SWITCH: float = 0.9

ROUNDING: float = 1e-15

LARGEST: float = 1000000000000.0

NOTHING: float = 1e-306

def all_finite(array: object) -> bool:
    """True if all numbers of a C-contiguous float64 array are finite."""

def normalise(normals: object) -> int:
    """
    Normalise (N, 3) directions in place. Return the first index off unit length by more than 1 %; -1: none.
    """

def along_normal(tangents: object, normals: object) -> int:
    """
    Return the index of the first of (N, 3) tangents parallel to its unit normal; -1: none.
    """

def cone_scale(friction: object, scale: object) -> None:
    """
    Fill `scale` (N, 3), cone coordinates = scale * force, from friction (N, 2) along o and t; 0: frictionless.
    """

class ContactReader:
    """Fast reader for the arguments of `Grasp.from_contacts`."""

    def __init__(self, *, least_friction: float, most_friction: float, least_length: float, most_length: float, distance: float, most: int) -> None:
        """
        Accepted ranges of friction and length of a grasp [m], distance of its origin in lengths, number of contacts.
        """

    def read(self, positions: object, normals: object, friction: object, tangents: object) -> Contacts | None:
        """
        Make hard contacts from float64 arrays: (N, 3), friction a float, (N,) or (N, 2), tangents (N, 3) or None.
        Return None if one has another class, shape or layout or is out of range, or if the rank is not 6 beyond doubt.
        """

class Contacts:
    """
    Contacts: friction, weights and places. The arrays are those of a `Grasp`.
    """

    @staticmethod
    def make(positions: object, normals: object, scale: object, weights: object, tangents: object) -> Contacts:
        """
        Make hard contacts: (N, 3) positions [m], inward unit normals and scale of cone coordinates, (N, 2) omega and
        lambda, (N, 3) tangents or (0, 3). Raises ValueError for unusable numbers.
        """

    @staticmethod
    def put(positions: object, normals: object, scale: object, torsion: object, tangents: object) -> Contacts:
        """
        The same with (N,) torsional friction [m]; the caller checks `refused` and `clear`.
        """

    @overload
    def weighed(self, force_weight: float, barrier_weight: float) -> Contacts:
        """
        Copy for solvers with omega and lambda, keeping the current tangents. Raises ValueError unless the rank of G is 6.
        """

    @overload
    def weighed(self, weights: object) -> Contacts:
        """The same with (N, 2) omega and lambda."""

    @property
    def count(self) -> int:
        """Number of contacts."""

    @property
    def refused(self) -> bool:
        """
        True if numbers are not finite, positions all at one point or normals not of unit length.
        """

    @property
    def clear(self) -> bool:
        """True if the rank is 6 beyond doubt, torsion included."""

    def within_reach(self, wrench: object, to: object) -> None:
        """
        Write the part of a wrench (6,) that forces of these contacts can make into `to` (6,).
        """

    @property
    def rank(self) -> int:
        """Rank of G, torsion included."""

    @property
    def soft(self) -> bool:
        """True if any contact transmits torsion."""

    @property
    def length(self) -> float: ...

    @property
    def centre(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

    @property
    def positions(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

    @property
    def normals(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

    @property
    def tangents(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]:
        """(N, 3) given tangents, or (0, 3) for the default rule."""

    @property
    def frames(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

    @property
    def matrix(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

    @property
    def cone_matrix(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

    @property
    def torsion_matrix(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

    @property
    def unit_frame(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]: ...

class Problem:
    """
    `grasp::Problem`: contacts with the weights of Phi, and limits besides friction.
    """

    def __init__(self, contacts: Contacts, weights: object | None = None, limits: object | None = None, margin: object | None = None) -> None:
        """
        weights: omega and lambda of all contacts, or an array (N, 2); None: 1 and 0.01.
        limits: (min_normal, max_normal, jacobian, torque_limit, torque_bias), each an array or None.
        margin: None, a float, or an object with `friction` and `preload`.
        """

class Options:
    """`grasp::Options`."""

    def __init__(self, *, method: str = 'newton', criterion: str = 'sum', start: int = 0, tolerance: float = 0.0, limit: int = 20000, elastic: bool = False, step_rule: object | None = None, model: Model | None = None, remembers: bool = True) -> None:
        """
        criterion: sum, max or torque; start: index into the names of `Start`;
        step_rule: (5,) kind, first, grow, shrink, decrease.
        """

class Request:
    """
    `grasp::Request` without its wrench and changes: the start of a call, and a study of it.
    """

    def __init__(self, *, start: int = 0, force: object | None = None, previous: object | None = None, optimum: float = float('nan'), trace: object | None = None) -> None:
        """
        force: (N, 3) [N]; previous: a solution; optimum: a known minimum of Phi;
        trace: (T,) receives Phi of the first iterates.
        """

ACCEPTED_GAP: float = 0.01

CLEAR: float = 1e-09

def combine(basis: object, wrench: object, printed: bool, to: object) -> None:
    """
    Combine a 12-basis with the optimum at rest (13, M) for a wrench, into (M,).
    printed: without the optimum at rest (Eqs. 33, 34).
    """

class ForceOptimizer:
    """`grasp::ForceOptimizer`; use `grasp_env.force.ForceOptimizer`."""

    def __init__(self, problem: Problem, options: Options = ..., kind: object = ..., names: object | None = None) -> None:
        """kind: the class of solutions; names: what `Solution._names` returns."""

    def solve(self, wrench: object | None, changes: object | None = None, request: Request | None = None) -> object:
        """
        Return a solution, whose code says whether it holds a force; NotImplemented if wrench or changes are not
        C-contiguous float64 arrays of the right shapes. changes: (positions, normals, friction, jacobian, torque_bias,
        contacts, margin), None where nothing changes.
        """

    def solve_call(self, wrench: object, changes: tuple | None, /) -> object:
        """`solve` without a request."""

    def start(self, wrench: object, changes: object | None, request: Request) -> object:
        """
        The same for the start alone: code `started`, and the start in `initial_force`.
        """

    def update(self, changes: object) -> bool:
        """
        Replace contacts and limits for later calls. Return False, with nothing changed, if they are impossible.
        """

    @property
    def previous(self) -> object:
        """The last solution with a force, or None."""

    def remember(self, solution: object) -> bool:
        """
        Take a solution as the last one. Return False if it holds no force or has another number of contacts.
        """

    def forget(self) -> None:
        """Forget the last solution."""

    def set_basis(self, basis: object) -> None:
        """Set the 12-basis with the optimum at rest, (13, 3N) cone coordinates."""

    def make_basis(self, basis: object, warm: bool) -> float:
        """
        Compute that basis into `basis` and use it; warm: `basis` holds that of nearby contacts.
        Return the worst relative gap; inf: not converged, nan: no force closure.
        """

    def payload(self, direction: object, wrench: object, tolerance: float, force: object, torsion: object, twist: object, multipliers: object) -> tuple[int, int, bool, float, float]:
        """
        Find the largest k for which forces hold wrench + k direction, (6,) each, with force (N, 3), torsion (N,), twist (6,) and multipliers (M,). Return (code, iterations, unbounded, k, bound).
        """

    def deepest(self, wrench: object, force: object, torsion: object, twist: object) -> tuple[int, int, float]:
        """
        Find the force (N, 3) and torsion (N,) deepest inside cones and limits, or the twist (6,) that proves that
        none is inside. Return (code, iterations, margin).
        """

    def solve_many(self, wrenches: object, rows: object) -> None:
        """Solve (M, 6) wrenches into (M, size); releases the GIL."""

    def times(self, wrenches: object, passes: int, rows: object, best: object) -> None:
        """
        Write the best times (M,) [s] of `passes` calls for each of (M, 6) wrenches, and the last rows.
        """

    @property
    def count(self) -> int:
        """Number of contacts."""

    @property
    def size(self) -> int:
        """Number of values in a row."""

def newton_grasps(contacts: list, weights: object, first: object, stop: tuple[float, int], wrenches: object, records: object, margin: object | None = None) -> None:
    """
    Solve wrenches on U placed contacts, with `weights` (N, 2) for all; wrenches first[u] to first[u + 1] - 1 belong to
    contacts u. stop: relative gap, and largest number of steps. margin: as for `Problem`.
    Writes complete rows of solutions; releases the GIL.
    REFUSED: soft contacts, or no force closure.
    """

def conic_grasps(contacts: list, weights: object, first: object, stop: tuple[float, int], wrenches: object, records: object, margin: object | None = None) -> None:
    """
    Solve wrenches on U placed contacts, with `weights` (N, 2) for all; wrenches first[u] to first[u + 1] - 1 belong to
    contacts u. stop: relative gap, and largest number of steps. margin: as for `Problem`.
    Writes complete rows of solutions; releases the GIL.
    REFUSED: soft contacts, or no force closure.
    """

LAYER_FACTS: int = 4

def layer_state_size(contacts: int) -> int:
    """Return the number of values in a problem's state."""

class ForceProblems:
    """
    Problems with any leading dimensions, read in place.

    The inputs are positions, normals, friction, tangents, torsional friction, wrench, jacobian, torque limit,
    torque bias, smallest and largest normal force, omega, lambda, and optionally a start: float64 or float32
    tensors or arrays on the CPU, whose leading dimensions broadcast; numbers for all contacts or joints; or None.
    """

    @staticmethod
    def of(given: tuple, most_contacts: int, most_joints: int) -> ForceProblems | None:
        """
        Return None for a type or a layout that cannot be read in place: convert it, or report an error.
        """

    @property
    def lead(self) -> tuple:
        """Leading dimensions."""

    @property
    def size(self) -> int:
        """Product of the leading dimensions."""

    @property
    def contacts(self) -> int: ...

    @property
    def joints(self) -> int: ...

    @property
    def jacobian_rows(self) -> int: ...

    @property
    def float32(self) -> bool:
        """True if no tensor with dimensions is float64."""

    def solve(self, range: tuple[int, int], stop: tuple[float, int], results: tuple) -> None:
        """
        Write the optimal forces of the problems first to last, range (first, last + 1), into arrays for all problems:
        force, torsion, multipliers, facts and state, see `BatchForces`. stop: relative gap, most steps. Releases the GIL.
        """

    def differentiate(self, range: tuple[int, int], state: object, losses: tuple, elastic: bool, gradients: tuple) -> None:
        """
        Write the gradients of a loss by the inputs into arrays, in their order, or None. losses: its derivatives by force,
        torsion and multipliers; None: zero. Releases the GIL.
        """

FULL_CONTACTS: int = 8

def descend_flow(contacts: Contacts, form: str, options: Options, wrench: object, request: Request, record: object) -> int:
    """
    Run a flow from the force of a request, balanced and inside the cones; write the record and return the code.
    """

def repeat_step(contacts: Contacts, form: str, x: object, times: int) -> float:
    """
    Compute the step of a flow at x (3N,), cone coordinates, `times` times; return its last number.
    form: full (Eq. 12, up to FULL_CONTACTS), paper (Eq. 26) or reduced, the same in the cheapest form.
    """

def limit_rows(limits: tuple, matrix: object, bounds: object, limited: object) -> int:
    """
    Write the finite limits of (min_normal (N,), max_normal (N,), jacobian (N, 4, J), torque_limit (J,), torque_bias
    (J,)) as rows A f <= b on force and torsion: A (R, N, 4), b (R,) and the size of each limit (R,), R = 2 (N + J).
    Return the number of rows.
    """

PLAIN_FEATURES: int = 8

MOST_STAGES: int = 8

WIDEST: int = 1024

class Network:
    """A float32 perceptron with activation v/2 (1 + v / sqrt(1 + v^2))."""

    @staticmethod
    def make(sizes: Sequence[int], weights: object) -> Network:
        """
        sizes: inputs, hidden ..., outputs; weights: for each stage the matrix (inputs x outputs), then its bias, flat.
        """

class Model:
    """A trained model for given contacts."""

    @staticmethod
    def make(network: Network, pairs: Network) -> Model:
        """
        pairs: one stage that maps a wrench's direction to vectors, whose lengths are further inputs of the network.
        """

    def normalise(self, floor: float, smoothing: float, log_mean: float, log_scale: float, friction_mean: float, friction_scale: float) -> None:
        """Set the scaling of the network's features, see policies/features.py."""

    def place(self, null_space: object, friction: float, scale: float, largest: float) -> None:
        """
        Set the contacts. null_space: (3N, 3N - 6) internal forces, the basis of the network's outputs; scale:
        sqrt(lambda / omega) relative to that of training; largest: size of the largest training wrench [N],
        < 0: none is covered.
        """

    def save(self) -> bytes:
        """
        Return the bytes of a model file, which `grasp::ModelFile` reads in C++.
        """

    @staticmethod
    def load(bytes: bytes) -> Model | None:
        """
        Return the model that `save` wrote; None if the bytes are not a whole file.
        """

    def covers(self, wrench: object) -> bool:
        """
        True if the wrench (unit frame), contacts and friction lie in the training range.
        """

    def predict(self, wrench: object, coordinates: object) -> None:
        """
        Predict the internal force for a wrench (unit frame), as coordinates (3N - 6,) [N] in the null space.
        """

def phi(x: object, weights: object) -> float:
    """
    Return Phi of forces (N, 3) or (N, 4) in cone coordinates with weights (N, 3) omega, lambda and k - 1, k tangential parts; inf: not strictly inside.
    """

def phi_gradient(x: object, weights: object, out: object) -> None:
    """Write the gradient of Phi, shaped as x."""

def phi_hessian(x: object, weights: object, out: object) -> None:
    """Write the blocks of the Hessian of Phi into (N, 3, 3) or (N, 4, 4)."""

def phi_lower_bound(y: object, weights: object) -> float:
    """
    Return the sum over contacts of the minimum of phi(x) - y . x, y (N, 3) or (N, 4); -inf: none.
    """

class Surface:
    """A surface, body frame; the axis of cylinders and capsules is y."""

    @staticmethod
    def make(kind: str, numbers: object) -> Surface:
        """
        numbers (3,) [m]: cuboid, half its sides; cylinder, radius and half its height; sphere, radius;
        capsule, radius and half the length of its axis.
        """

    @staticmethod
    def mesh(corners: object, faces: object, pieces: Sequence[object]) -> Surface:
        """
        A closed mesh: corners (V, 3) [m] and their indices (F, 3) as float64, counterclockwise from outside;
        pieces: corners (K, 3) [m] of convex pieces whose union is the solid.
        """

    def nearest(self, center: object) -> tuple[NDArray, NDArray, float]:
        """
        Return the nearest point (3,) [m], or one of them, the INWARD unit normal there and the distance [m],
        negative inside. On edges the normal is the direction to the point.
        """

REACHED: float = 1e-09

class Link:
    """A link of a hand and the joint that moves it."""

    def __init__(self, *, parent: int, offset: Sequence[float], rotation: Sequence[float], axis: Sequence[float], mass: float, center: Sequence[float], lower: float, upper: float, torque_limit: float, sliding: bool = False, driver: int = -1, ratio: float = 1.0, shift: float = 0.0, inertia: Sequence[float] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]) -> None:
        """
        The members of `grasp::Link`, see hand/tree.hpp; rotation and inertia row by row.
        """

class Tip:
    """The sphere with which a finger touches."""

    def __init__(self, *, link: int, center: Sequence[float], radius: float) -> None:
        """center: [m] in the link's frame."""

class Tree:
    """A hand as an immutable tree of M links with N fingertips."""

    @staticmethod
    def make(links: Sequence[Link], tips: Sequence[Tip]) -> Tree:
        """Make a hand. Parents must come before their links."""

    @property
    def joints(self) -> int: ...

    @property
    def fingers(self) -> int: ...

    def couple(self, angles: object) -> None:
        """Set the coupled joints in angles (M,) from their drivers."""

    def trace(self, angles: object, rotations: object, origins: object) -> None:
        """
        Write the frames of the links at angles (M,) [rad], world frame: rotations (M, 3, 3) and origins (M, 3) [m].
        """

    def tips(self, angles: object, centers: object) -> None:
        """Write the centres of the fingertips [m], world frame, into (N, 3)."""

    def jacobian(self, angles: object, link: int, place: object, jacobian: object) -> None:
        """
        Write the velocity of a point (3,) [m] of a link per joint speed, world frame, into (3, M).
        """

    def mobility(self, angles: object) -> tuple[list[float], list[float]]:
        """
        Mobility of tips (N,) [1/kg] and joints (M,) [1/(kg m^2)]: see mobility.hpp.
        """

    def mass_matrix(self, angles: object, matrix: object) -> None:
        """
        Write the mass matrix (M, M) [kg m^2]; rows and columns of coupled joints are zero.
        """

    def gravity_torques(self, angles: object, gravity: object, torques: object) -> None:
        """
        Write the torques that carry the weight of all links under a gravity (3,) [m/s^2], into (M,) [N m].
        """

    def statics(self, angles: object, points: object, gravity: object, jacobian: object, torques: object) -> None:
        """
        Write the Jacobians of the points (N, 3) [m] where the tips touch, into (N, 3, M), and `gravity_torques`, into (M,).
        """

    def save(self) -> bytes:
        """Return the bytes of a hand file, which `grasp::TreeFile` reads in C++."""

    @staticmethod
    def load(bytes: bytes) -> Tree | None:
        """
        Return the hand that `save` wrote; None if the bytes are not a whole file.
        """

class Reach:
    """
    Inverse kinematics of a hand: damped least squares within the joint limits.
    """

    @staticmethod
    def make(tree: Tree, limited: bool = True) -> Reach:
        """limited: True to stay within the joint limits."""

    @property
    def groups(self) -> list[tuple[list[int], list[int]]]:
        """Groups of fingers that share joints, and these joints."""

    def solve(self, targets: object, starts: object, angles: object, missed: object) -> None:
        """
        Bring the tips near targets (N, 3) [m], from starts (S, M) in this order; write the angles (M,) [rad] and
        for each group the distance (G,) of its worst tip from the target [m].
        """

class Limb:
    """A convex shape fixed to a link; -1: the palm."""

    @staticmethod
    def line(*, link: int, start: Sequence[float], end: Sequence[float], radius: float, tip: bool) -> Limb:
        """
        All points within a radius of a line [m], link frame; tip: part of a fingertip.
        """

    @staticmethod
    def solid(*, link: int, kind: str, half: Sequence[float], center: Sequence[float], rotation: Sequence[float], corners: object, tip: bool) -> Limb:
        """
        kind: box, half its sides; cylinder about z, radius, radius and half its height; hull, (K, 3) corners
        relative to a point inside [m]. center [m] and rotation (9,), link frame.
        """

class HandLimbs:
    """The limbs of a hand, and its fingers as separate trees."""

    @staticmethod
    def make(tree: Tree, limbs: Sequence[Limb], home: object, together: Sequence[tuple[int, int]] = []) -> HandLimbs:
        """
        home (M,) [rad]: start of the inverse kinematics; together: pairs of links that may touch, -1: the palm.
        """

    def moved(self, turn: Sequence[float], shift: Sequence[float], home: object) -> HandLimbs:
        """
        Return the same hand with its palm rotated (9,), then shifted [m], and with another rest posture (M,).
        """

    def clearance(self, surface: Surface, angles: object, enough: float = float('inf')) -> tuple[float, float]:
        """
        Return the smallest distances [m] at angles (M,), at most `enough`: of the links, without the tips' spheres, from
        an object; of links and tips from one another.
        """

    def link_gaps(self, angles: object, enough: float) -> list[tuple[int, int, float]]:
        """
        Return the pairs of limbs of different links, not of one joint, at most `enough` apart [m]:
        (link, link, distance). Coupled joints follow their drivers.
        """

    def beside(self, finger: int, angles: object, middles: object, enough: float, gaps: object) -> None:
        """
        Write (K,) distances, at most `enough` [m], of the rest of a finger and the palm in postures (K, M) from balls
        about `middles` (K, 3) that touch its tip.
        """

    @property
    def free(self) -> list[bool]:
        """For each finger, True if its tip can go anywhere nearby."""

    def palm_gap(self, surface: Surface) -> float:
        """Return the distance of the palm from an object [m]."""

class GraspSearch:
    """A search for contacts with which a hand holds an object."""

    @staticmethod
    def make(hand: HandLimbs, surface: Surface, *, friction: float, torsion: float, length: float, space: float, start: float, gravity: Sequence[float], loads: object, directions: object) -> GraspSearch:
        """
        The members of `grasp::Demand`, see planner/place.hpp, with loads (L, 6); directions: (D, 6) to compare places.
        """

    def fill(self, finger: int, draws: object, spread: Sequence[float], margins: Sequence[float], most: int) -> int:
        """
        Find places of a finger anew and return their number.
        draws: (S, 6) in [0, 1); (draws - 1/2) * spread (6,) gives the start inside the object [m] and the offset of the
        direction towards the finger.
        margins: [m] of flat surface, [rad] from joint limits, [m] of clearance, [m] largest distance of a mesh's pieces.
        """

    def choose(self, picks: Sequence[Sequence[int]], forces: object, points: object, normals: object, choices: object) -> int:
        """
        Find the best choice of each round: write its total normal force [N] in the worst case into (R,), points and
        normals into (R, N, 3), places into (R, N). Return the number of rounds. picks: random numbers >= 0 per finger
        for the initial choices.
        """

    def misses(self, finger: int) -> list[int]:
        """
        Return the number of rays that failed: at an edge, out of reach, near a joint limit, with a link at the object,
        without room to start, with too little push along the normal.
        """

    def assemble(self, choice: Sequence[int], clearance: float, angles: object, start: object) -> int:
        """
        Write the angles (M,) of the whole hand at a choice of places, and before it closes, as far as they exist. Return
        0, or the fault: 1 a link nearer to the object than `clearance` [m], 2 links touch, 3 no start, 4 and 5 as 1 and 2
        at the start, 6 fingers of one motor do not touch together.
        """

class Answers:
    """
    Positions of the numbers in the nested tuples that a simulator returns.
    """

    def __init__(self, *, link: int, place: int, forces: Sequence[tuple[int, int]], factor: float, first: int, links: Sequence[int]) -> None:
        """
        For a contact: items of the engine's link number and of the point, pairs of items that hold amounts and directions
        of forces; factor of all amounts, below 0 if they push the hand. links: the hand's link for each of the engine's,
        from number `first` on; -1: none.
        """

    def read(self, joints: object, pose: object, velocity: object, contacts: object) -> numpy.typing.NDArray[numpy.float64]:
        """
        Return joints ((angle, rate, ...), ...), pose (position, quaternion), velocity (linear, angular) and contacts
        as the flat numbers of `Scene.read`, a new array.
        """

def reading_size(joints: int, contacts: int) -> int:
    """Return the number of values in a reading."""

class Scene:
    """A hand and an object in a simulator, as last read."""

    @staticmethod
    def make(tree: Tree, surface: Surface, gravity: Sequence[float], mass: float) -> Scene:
        """gravity: (3,) [m/s^2], world frame. mass: of the object [kg]."""

    @property
    def mass(self) -> float:
        """Mass of the object [kg]."""

    @mass.setter
    def mass(self, arg: float, /) -> None: ...

    def set_gravity(self, gravity: Sequence[float]) -> None:
        """Set the gravity (3,) [m/s^2], world frame."""

    def read(self, numbers: object) -> bool:
        """
        Read angles (M,), rates (M,), the object's position, quaternion (x y z w), linear and angular velocity, and per
        contact the hand's link, the point [m] and the force ON the object [N]; world frame. Return False if numbers are
        not finite or the object is lost.
        """

    def arrays(self) -> dict[str, NDArray]:
        """Views of the scene's state by name; overwritten at each reading."""

class Gather:
    """
    Gathers the numbers of several arrays, clipped, into a new float32 array.
    """

    def __init__(self, arrays: Sequence[Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)]], bound: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> None:
        """
        C-contiguous float64 arrays, read at each call, and a float32 bound for each of their numbers.
        """

    def __call__(self) -> numpy.typing.NDArray[numpy.float32]: ...

class HandState:
    """What a hand and its sensors know at an update."""

    def __init__(self, joints: int, fingers: int) -> None: ...

    @property
    def numbers(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]:
        """All parts in one row, for messages."""

    @property
    def angles(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @angles.setter
    def angles(self, arg: object, /) -> None: ...

    @property
    def rates(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @rates.setter
    def rates(self, arg: object, /) -> None: ...

    @property
    def touching(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @touching.setter
    def touching(self, arg: object, /) -> None: ...

    @property
    def positions(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @positions.setter
    def positions(self, arg: object, /) -> None: ...

    @property
    def normals(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @normals.setter
    def normals(self, arg: object, /) -> None: ...

    @property
    def wrench(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @wrench.setter
    def wrench(self, arg: object, /) -> None: ...

    @property
    def gravity(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @gravity.setter
    def gravity(self, arg: object, /) -> None: ...

    @property
    def object(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @object.setter
    def object(self, arg: object, /) -> None: ...

    @property
    def target(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @target.setter
    def target(self, arg: object, /) -> None: ...

    @property
    def ages(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]: ...

    @ages.setter
    def ages(self, arg: object, /) -> None: ...

class Spring:
    """Draws a tip to its place."""

    def __init__(self, gain: float, damping: float, limit: float) -> None:
        """[N/m], [N s/m], largest force [N]"""

class Calibration:
    """From joint torques to units of motors."""

    def __init__(self) -> None: ...

    @staticmethod
    def newton_metres(hand: Tree) -> Calibration: ...

    @staticmethod
    def currents(torque_constant: Sequence[float], largest: Sequence[float], units_per_ampere: Sequence[float]) -> Calibration: ...

    @property
    def torques(self) -> list[list[float]]: ...

    @torques.setter
    def torques(self, arg: Sequence[Sequence[float]], /) -> None: ...

    @property
    def units(self) -> list[list[float]]: ...

    @units.setter
    def units(self, arg: Sequence[Sequence[float]], /) -> None: ...

    @property
    def friction(self) -> list[float]: ...

    @friction.setter
    def friction(self, arg: Sequence[float], /) -> None: ...

    @property
    def dead_band(self) -> list[float]: ...

    @dead_band.setter
    def dead_band(self, arg: Sequence[float], /) -> None: ...

    @property
    def fade(self) -> float: ...

    @fade.setter
    def fade(self, arg: float, /) -> None: ...

    @property
    def resolution(self) -> float: ...

    @resolution.setter
    def resolution(self, arg: float, /) -> None: ...

    def check(self, joints: int) -> None:
        """Raise a ValueError unless it fits a hand."""

    def limit(self, joint: int) -> float:
        """Torque available in both directions [N m]."""

    def __call__(self, joint: int, torque: float, wanted: float = 0.0) -> float: ...

class Hold(enum.Enum):
    """Behaviour of the fingers in contact: see hand_settings.hpp."""

    optimized = 0

    squeeze = 1

    place = 2

    direct = 3

    reach = 4

class HandControllerSettings:
    """See hand_settings.hpp."""

    def __init__(self) -> None: ...

    @property
    def friction(self) -> float: ...

    @friction.setter
    def friction(self, arg: float, /) -> None: ...

    @property
    def torsional_friction(self) -> float: ...

    @torsional_friction.setter
    def torsional_friction(self, arg: float, /) -> None: ...

    @property
    def friction_margin(self) -> float: ...

    @friction_margin.setter
    def friction_margin(self, arg: float, /) -> None: ...

    @property
    def preload(self) -> float: ...

    @preload.setter
    def preload(self, arg: float, /) -> None: ...

    @property
    def rate(self) -> float: ...

    @rate.setter
    def rate(self, arg: float, /) -> None: ...

    @property
    def budget(self) -> float: ...

    @budget.setter
    def budget(self, arg: float, /) -> None: ...

    def set_follow(self, tolerance: float, limit: int, conic: bool = False) -> None:
        """
        Set the solver between two solves of the method, Newton or conic: relative certified gap, most steps.
        """

    @property
    def joint_delay(self) -> float: ...

    @joint_delay.setter
    def joint_delay(self, arg: float, /) -> None: ...

    @property
    def grip(self) -> Spring: ...

    @grip.setter
    def grip(self, arg: Spring, /) -> None: ...

    @property
    def place(self) -> Spring: ...

    @place.setter
    def place(self, arg: Spring, /) -> None: ...

    @property
    def reach_stiffness(self) -> float: ...

    @reach_stiffness.setter
    def reach_stiffness(self, arg: float, /) -> None: ...

    @property
    def reach_force(self) -> float: ...

    @reach_force.setter
    def reach_force(self, arg: float, /) -> None: ...

    @property
    def reach_limit(self) -> float: ...

    @reach_limit.setter
    def reach_limit(self, arg: float, /) -> None: ...

    @property
    def posture_stiffness(self) -> float: ...

    @posture_stiffness.setter
    def posture_stiffness(self, arg: float, /) -> None: ...

    @property
    def posture_damping(self) -> float: ...

    @posture_damping.setter
    def posture_damping(self, arg: float, /) -> None: ...

    @property
    def damping(self) -> float: ...

    @damping.setter
    def damping(self, arg: float, /) -> None: ...

    @property
    def force_rate(self) -> float: ...

    @force_rate.setter
    def force_rate(self, arg: float, /) -> None: ...

    @property
    def torque_rate(self) -> float: ...

    @torque_rate.setter
    def torque_rate(self, arg: float, /) -> None: ...

    @property
    def release(self) -> int: ...

    @release.setter
    def release(self, arg: int, /) -> None: ...

    @property
    def stale(self) -> float: ...

    @stale.setter
    def stale(self, arg: float, /) -> None: ...

    @property
    def stale_wrench(self) -> float: ...

    @stale_wrench.setter
    def stale_wrench(self, arg: float, /) -> None: ...

    @property
    def grace(self) -> float: ...

    @grace.setter
    def grace(self, arg: float, /) -> None: ...

    @property
    def fade(self) -> float: ...

    @fade.setter
    def fade(self, arg: float, /) -> None: ...

    @property
    def remembers(self) -> bool: ...

    @remembers.setter
    def remembers(self, arg: bool, /) -> None: ...

    @property
    def directions(self) -> list[float]: ...

    @directions.setter
    def directions(self, arg: Sequence[float], /) -> None: ...

    @property
    def squeeze(self) -> float: ...

    @squeeze.setter
    def squeeze(self, arg: float, /) -> None: ...

class Effort:
    """
    Effort of solvers and motors since an agent's step began: see hand_settings.hpp.
    """

    @property
    def iterations(self) -> int: ...

    @property
    def trials(self) -> int: ...

    @property
    def followed(self) -> int: ...

    @property
    def limited(self) -> int: ...

    @property
    def saturated(self) -> bool: ...

    @property
    def margin(self) -> float: ...

    @property
    def share(self) -> float: ...

class HandRecording:
    """Rows of a hand controller: see recording.hpp."""

    @property
    def columns(self) -> list[str]:
        """Names of the columns, with their units."""

    @property
    def header(self) -> str:
        """JSON of all that a replay needs."""

    @property
    def full(self) -> bool:
        """True if no row fits any more."""

    def rows(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]:
        """Return a copy of the rows."""

    def write(self, path: str) -> None:
        """Write CSV; the file appears when complete."""

class HandController:
    """The controller of a torque-controlled hand: see hand_controller.hpp."""

    def __init__(self) -> None: ...

    STATUSES: tuple = ...

    def configure(self, hand: Tree, settings: HandControllerSettings, calibration: Calibration, home: Sequence[float], optimizer: object | None = None) -> None:
        """
        Make all objects of an update. home: (M,) posture of the gains. optimizer: the `ForceOptimizer` of agents' steps
        for the contacts of all fingers, which is copied; None: Newton with the friction and the margin of the settings.
        """

    def activate(self, state: HandState) -> bool:
        """
        Start at a state, from which torques rise from zero; False: it is not of this hand or not finite.
        """

    def take_hold(self) -> None:
        """
        Make the places of the touching fingers where they are now, once a grasp has settled.
        """

    def deactivate(self) -> None:
        """Command zero torque from now on."""

    def update(self, state: HandState, period: float) -> object:
        """
        Return commands (M,) in device units for the newest state; period: since the last update [s].
        """

    def record(self, seconds: float) -> None:
        """Record from the next `activate` on, for as many seconds at most."""

    @property
    def recording(self) -> HandRecording:
        """What was recorded since `activate`."""

    @property
    def torque_limits(self) -> list[float]:
        """(M,) torques that motors and calibration give [N m]."""

    @property
    def friction_used(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]:
        """(N,) share of the friction that each commanded force uses."""

    def observe(self, state: HandState, period: float) -> None:
        """
        First half of `update`: take the state and count the fingers in contact.
        """

    def act(self, due: bool, adjustment: object | None = None, start: object | None = None, given: object | None = None, residual: object | None = None, margin: object | None = None) -> list[float]:
        """
        Second half of `update`: find forces, and return the joint torques (M,) [N m] that produce them.
        due: True if an agent's step begins, with adjustment (K,) [N] of the start. start: (N, 3) [N], contact frames,
        start of the method; given: (N, 3) [N], contact frames, forces for `Hold.direct`. residual: (N, 3) [N], contact
        frames: moves the optimal forces to the nearest balanced ones of their sum. margin: (2,) friction [1] and preload [N].
        """

    @property
    def hold(self) -> Hold:
        """Behaviour of the fingers in contact."""

    @hold.setter
    def hold(self, arg: Hold, /) -> None: ...

    @property
    def status(self) -> str:
        """What the torques do."""

    @property
    def duration(self) -> float:
        """Time of the last update [s]."""

    @property
    def late(self) -> int:
        """Number of updates after a missed deadline."""

    @property
    def over_budget(self) -> int:
        """Number of updates longer than the budget."""

    @property
    def effort(self) -> Effort: ...

    @property
    def code(self) -> int:
        """Code of the method's last solve."""

    @property
    def closure(self) -> bool:
        """True if forces balance the wrench."""

    def arrays(self) -> dict[str, NDArray]:
        """Views of the commands by name; overwritten in place."""

    @property
    def mask(self) -> int:
        """Fingers that count as in contact: 2^i for finger i."""

    @property
    def changes(self) -> int:
        """Number of changes of `mask`."""

    @property
    def rising(self) -> bool:
        """True if torques are on their way, as fast as they may change."""

    @property
    def peak(self) -> float:
        """Largest torque since `activate` [N m]."""

class Body:
    """Model of the object and gains of its pose feedback: see balance.hpp."""

    def __init__(self) -> None: ...

    @property
    def mass(self) -> float: ...

    @mass.setter
    def mass(self, arg: float, /) -> None: ...

    @property
    def inertia(self) -> list[float]:
        """(9,) [kg m^2] about its centre, object frame"""

    @inertia.setter
    def inertia(self, arg: Sequence[float], /) -> None: ...

    @property
    def position_gain(self) -> float: ...

    @position_gain.setter
    def position_gain(self, arg: float, /) -> None: ...

    @property
    def position_damping(self) -> float: ...

    @position_damping.setter
    def position_damping(self, arg: float, /) -> None: ...

    @property
    def rotation_gain(self) -> float: ...

    @rotation_gain.setter
    def rotation_gain(self, arg: float, /) -> None: ...

    @property
    def rotation_damping(self) -> float: ...

    @rotation_damping.setter
    def rotation_damping(self, arg: float, /) -> None: ...

    def wrench(self, scene: Scene, target: object, gravity: object) -> list[float]:
        """
        Weight - inertial wrench of the target motion + pose feedback (6,) [N, N m], object frame.
        """

class WrenchSource(enum.Enum):
    """Source of the external wrench."""

    measured = 0

    estimated = 1

    none = 2

class SensorSettings:
    """Delay and noise of the controller's sensors: see sensing.hpp."""

    def __init__(self) -> None: ...

    @property
    def wrench(self) -> WrenchSource: ...

    @wrench.setter
    def wrench(self, arg: WrenchSource, /) -> None: ...

    @property
    def tick(self) -> float: ...

    @tick.setter
    def tick(self, arg: float, /) -> None: ...

    @property
    def keep(self) -> float: ...

    @keep.setter
    def keep(self, arg: float, /) -> None: ...

    @property
    def joint_delay(self) -> int: ...

    @joint_delay.setter
    def joint_delay(self, arg: int, /) -> None: ...

    @property
    def delay(self) -> int: ...

    @delay.setter
    def delay(self, arg: int, /) -> None: ...

    @property
    def wrench_delay(self) -> int: ...

    @wrench_delay.setter
    def wrench_delay(self, arg: int, /) -> None: ...

    @property
    def pose_noise(self) -> float: ...

    @pose_noise.setter
    def pose_noise(self, arg: float, /) -> None: ...

    @property
    def tactile_noise(self) -> float: ...

    @tactile_noise.setter
    def tactile_noise(self, arg: float, /) -> None: ...

class Costs:
    """Costs of an agent's step, each from 0 to 1: see simulated_hand.hpp."""

    @property
    def force(self) -> float: ...

    @property
    def torque(self) -> float: ...

    @property
    def change(self) -> float: ...

class Outcome:
    """Quality of the hold: see simulated_hand.hpp."""

    @property
    def drift(self) -> float: ...

    @property
    def tilt(self) -> float: ...

    @property
    def force_error(self) -> float: ...

    @property
    def slip(self) -> float: ...

    @property
    def stray(self) -> float: ...

    @property
    def imbalance(self) -> float: ...

    @property
    def speed(self) -> float: ...

    @property
    def force(self) -> float: ...

    @property
    def slide(self) -> float: ...

    @property
    def overlap(self) -> float: ...

    @property
    def stray_share(self) -> float: ...

class SimulatedHand:
    """
    The hand of a simulation beside its controller: its sensors, and what is true of the hold.
    """

    @staticmethod
    def make(scene: Scene, controller: HandController, optimizer: object, friction: float, body: Body, sensors: SensorSettings) -> SimulatedHand:
        """
        controller: configured. optimizer: the `ForceOptimizer` of the contacts of all fingers. friction: the true one, over
        that of the optimizer.
        """

    def reset(self) -> None:
        """
        Start a new episode and activate the controller; before its first tick the scene
        stands still.
        """

    def see(self, reading: object | None, external: object, gravity: object, target: object, noise: object | None) -> bool:
        """
        First half of a control tick: read the scene and let the controller observe it.
        Return False if the reading is not finite or the object is lost.
        reading: as for `Scene.read`; None: the scene has read it. external: the wrench (6,) that a perfect sensor reports;
        gravity (3,); target (19,); noise: standard normal numbers (3 + 3N,) if anything is noisy.
        """

    def rest(self, external: object, gravity: object, target: object, noise: object | None) -> None:
        """
        Set the measured forces as commanded ones, for a hand at rest; arguments as of `see`.
        """

    def begin_step(self) -> None:
        """Begin an agent's step."""

    def costs(self) -> Costs:
        """
        Return the costs of the step since `begin_step`, on the contacts currently seen.
        """

    def outcome(self, target: object, error: object, measured: object) -> Outcome:
        """
        Return the outcome from the true state; write the pose error (12,) against a target (19,), and the
        measured forces (N, 3) in the commanded contact frames [N].
        """

    def step_info(self, outcome: Outcome, measured: object) -> dict[str, object]:
        """
        Return the report of a step by name: the method's solution, contacts, forces [N], effort, and an
        outcome with its measured forces (N, 3). The arrays are copies.
        """

    def seen(self) -> dict[str, NDArray]:
        """Views of the observed state by name; overwritten in place."""

    @property
    def slid(self) -> Annotated[NDArray[numpy.float64], dict(order='C')]:
        """
        View of the distance (N,) that each tip slid on the object since `reset` [m], as it feels it.
        """

    @property
    def perfect(self) -> bool:
        """True to ignore delay and noise of the sensors."""

    @perfect.setter
    def perfect(self, arg: bool, /) -> None: ...

    @property
    def exact(self) -> bool:
        """True if the scene is seen without delay and noise."""

class ContactEstimator:
    """Contacts from joint torques: see contact_estimator.hpp."""

    def __init__(self, hand: Tree, touch: float, release: float, time_constant: float, largest_gap: float) -> None:
        """Settings: [N], [N], [s], [m]."""

    def set_surface(self, surface: Surface) -> None:
        """
        The contacts follow from the surface of the object and its pose in the state.
        """

    def set_normals(self, normals: object) -> None:
        """
        Without a surface: fingertips touch planes with these unit normals (N, 3) into the object, object frame.
        """

    def reset(self) -> None:
        """Forget all forces. The next update takes the hand to be at rest."""

    def update(self, state: HandState, torques: object, period: float) -> bool:
        """
        Write `touching`, `positions` and `normals` of a state. torques: (M,) [N m] that the motors delivered since the last
        update; period: since then [s]. False, with the last estimate, for numbers that are not finite.
        """

    @property
    def forces(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]:
        """(N, 3) of the fingertips ON the object [N], base frame."""

    @property
    def residual(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]:
        """(M,) torques of the contacts on the joints [N m]."""

    @property
    def gaps(self) -> Annotated[NDArray[numpy.float64], dict(order='C', writable=False)]:
        """(N,) from tip to surface [m]; NaN: no surface is known."""
