"""The compiled core; `grasp_env.core` is its door."""

from collections.abc import Sequence
import enum
from typing import Annotated, Any, overload

import numpy
import numpy as np
import numpy.typing
from numpy.typing import NDArray


def build_info() -> dict[str, str]:
    """
    Version, compiler, instruction set, build type, processor asked for and flags of this module.
    """

def record_fields() -> dict[str, int]:
    """
    Where the fields of a solution stand in its row of numbers; from `force` on 3N force, 3N initial force, N torsion.
    """

def codes() -> dict[str, int]:
    """How a solve ends, by name."""

def record_size(contacts: int) -> int:
    """Numbers in a row of N contacts."""

class Solution:
    """One record and what was said of it; see `grasp_env.force.ForceSolution`."""

    _record: NDArray[np.float64]
    method: str
    initial: str
    objective_trace: NDArray[np.float64]
    def __init__(
        self, record: NDArray[np.float64], method: str, initial: str, objective_trace: NDArray[np.float64] = ...
    ) -> None: ...
    @property
    def n_contacts(self) -> int: ...
    @property
    def code(self) -> int: ...
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
    @property
    def wrench(self) -> NDArray[np.float64]: ...
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
    """Whether all numbers of a C-contiguous float64 array are finite."""

def normalise(normals: object) -> int:
    """
    Gives (N, 3) directions unit length in place; returns the first that misses it by more than 1e-6, -1: none.
    """

def along_normal(tangents: object, normals: object) -> int:
    """
    The first of (N, 3) tangents that is along its unit normal, -1: none is.
    """

def cone_scale(friction: object, scale: object) -> None:
    """
    Fills (N, 3), cone coordinates = scale * force, of friction (N, 2) along o and t; 0: the normal force alone.
    """

class ContactReader:
    """Reads what `Grasp.from_contacts` is given where it is as it should be."""

    def __init__(self, *, least_friction: float, most_friction: float, least_length: float, most_length: float, distance: float, most: int) -> None:
        """
        Friction, length of a grasp [m], distance of its origin in lengths and number of contacts that are within range.
        """

    def read(self, positions: object, normals: object, friction: object, tangents: object) -> Contacts | None:
        """
        Hard contacts of float64 arrays: (N, 3), friction a float, (N,) or (N, 2), tangents (N, 3) or None. None: one of them
        is of another class, shape or layout or out of range, or the rank is not 6 beyond doubt.
        """

class Contacts:
    """
    Contacts: what they transmit and weigh, and where they are. Arrays are those of a `Grasp`.
    """

    @staticmethod
    def make(positions: object, normals: object, scale: object, weights: object, tangents: object) -> Contacts:
        """
        Hard ones: (N, 3) positions [m] and inward unit normals, (N, 3) scale of cone coordinates, (N, 2) omega and
        lambda, (N, 3) tangents or (0, 3). ValueError where the rank of G is not 6.
        """

    @staticmethod
    def put(positions: object, normals: object, scale: object, torsion: object, tangents: object) -> Contacts:
        """
        The same with (N,) torsional friction [m], wherever they are: see `refused` and `clear`.
        """

    @overload
    def weighed(self, force_weight: float, barrier_weight: float) -> Contacts:
        """
        A copy for solvers with omega and lambda, with the current tangents. ValueError where the rank of G is not 6.
        """

    @overload
    def weighed(self, weights: object) -> Contacts:
        """The same with (N, 2) omega and lambda."""

    @property
    def count(self) -> int:
        """N."""

    @property
    def refused(self) -> bool:
        """Not finite, or not unit normals."""

    @property
    def clear(self) -> bool:
        """Whether the rank is 6 beyond doubt, torsion included."""

    @property
    def soft(self) -> bool:
        """Whether torsion is transmitted anywhere."""

    @property
    def outwards(self) -> bool:
        """Whether all normals point away from the centre of the contacts."""

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
        """(N, 3) as given, (0, 3): the default rule."""

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

ACCEPTED_GAP: float = 0.01

CLEAR: float = 1e-09

def combine(basis: object, wrench: object, printed: bool, to: object) -> None:
    """
    The combination of a 12-basis with its rest (13, M) for a wrench, into (M,); `printed`: without the rest (Eqs. 33, 34).
    """

def advise(contacts: Contacts, wrench: object = None, jacobian: object = None, torque_limit: object = None) -> list[tuple[bool, str]]:
    """
    Likely mistakes: whether each is near certain, and its text. float64 arrays: (6,), (N, 3 or 6, J), (J,).
    """

def looks_wrong(contacts: Contacts, wrench: object | None = None, jacobian: object | None = None, torque_limit: object | None = None) -> bool:
    """True if some of that advice is near certain."""

class ForceOptimizer:
    """`grasp::ForceOptimizer`; `grasp_env.force.ForceOptimizer` is its door."""

    @staticmethod
    def make(contacts: Contacts, weights: object | None = None, force_weight: float = 1.0, barrier_weight: float = 0.01, min_normal: object | None = None, max_normal: object | None = None, jacobian: object | None = None, torque_limit: object | None = None, torque_bias: object | None = None, method: str = 'newton', largest: bool = False, start: int = 0, tolerance: float = 0.0, limit: int = 20000, elastic: bool = False, rule: object | None = None, model: Model | None = None, kind: object | None = None, name: object | None = None, starts: tuple = (), asked: object | None = None, remembers: bool = False) -> ForceOptimizer:
        """
        See `Problem` and `Options`. start: a number of `starts`, the names of each `Start`; kind: the class of solutions;
        asked: the name of the start that is asked for; remembers: whether calls get the previous solution.
        """

    def solve(self, wrench: object | None, positions: object | None, normals: object | None, friction: object | None, jacobian: object | None, torque_bias: object | None, contacts: object | None) -> object:
        """
        A solution; None: an argument cannot be read as it is, or there is no force and `ended` holds the row.
        """

    def solve_from(self, start: int, initial: object | None, force: object | None, before: object | None, optimum: float, trace: object | None, wrench: object, positions: object | None, normals: object | None, friction: object | None, jacobian: object | None, torque_bias: object | None, contacts: object | None) -> object:
        """
        The same from a start of its own; optimum: a known minimum or nan; trace: (T,) receives Phi of the first iterates.
        """

    def start(self, start: int, force: object | None, before: object | None, wrench: object, positions: object | None, normals: object | None, friction: object | None, jacobian: object | None, torque_bias: object | None, contacts: object | None) -> object:
        """The row of the start alone."""

    def update(self, positions: object | None, normals: object | None, friction: object | None, jacobian: object | None, torque_bias: object | None) -> bool:
        """
        From now on contacts and limits are these; False: they are not possible, and nothing has changed.
        """

    def set_basis(self, basis: object) -> None:
        """Takes the 12-basis with the rest, (13, 3N) cone coordinates."""

    def make_basis(self, basis: object, warm: bool) -> float:
        """
        Fills that, and takes it; returns the worst relative gap, inf: it did not converge, nan: no force closure. warm: it holds that of nearby contacts.
        """

    def deepest(self, wrench: object, force: object, torsion: object, twist: object) -> tuple[int, int, float]:
        """
        The force (N, 3) and torsion (N,) deepest inside cones and limits, or the twist (6,) that proves that none is;
        returns (code, iterations, margin).
        """

    def solve_many(self, wrenches: object, rows: object) -> None:
        """(M, 6) into (M, size); releases the GIL."""

    def times(self, wrenches: object, passes: int, rows: object, best: object) -> None:
        """
        Best seconds (M,) of `passes` calls for each of (M, 6), none of which knows another; the rows of the last.
        """

    @property
    def previous(self) -> object:
        """The last solution that has a force, or None."""

    @previous.setter
    def previous(self, solution: object | None) -> None: ...

    @property
    def ended(self) -> object:
        """
        The row of the last call that returned None, unless it could not read its arguments.
        """

    @property
    def count(self) -> int:
        """Contacts."""

    @property
    def size(self) -> int:
        """Numbers of a row."""

def newton_grasps(contacts: list, weights: object, first: object, tolerance: float, limit: int, wrenches: object, records: object) -> None:
    """
    U contacts in their place, whose own weights are not read but `weights` (N, 2); wrenches first[u] to
    first[u + 1] - 1 are those of contacts u. Into whole rows of solutions; releases the GIL.
    REFUSED: they are soft, or without force closure.
    """

def conic_grasps(contacts: list, weights: object, first: object, tolerance: float, limit: int, wrenches: object, records: object) -> None:
    """
    U contacts in their place, whose own weights are not read but `weights` (N, 2); wrenches first[u] to
    first[u + 1] - 1 are those of contacts u. Into whole rows of solutions; releases the GIL.
    REFUSED: they are soft, or without force closure.
    """

LAYER_FACTS: int = 4

def layer_state_size(contacts: int) -> int:
    """Numbers of a problem's state."""

class ForceProblems:
    """
    Problems with any leading dimensions, read where their numbers lie.

    Given are positions, normals, friction, tangents, torsional friction, wrench, jacobian, torque limit,
    torque bias, least and largest normal force, omega, lambda, and a start or none. Each is a tensor or an
    array on the CPU, float64 or float32, whose leading dimensions broadcast; a number for all contacts or
    joints; or None.
    """

    @staticmethod
    def of(given: tuple, most_contacts: int, most_joints: int) -> ForceProblems | None:
        """
        None: a type or a layout that is not read here; convert it, or say what is wrong.
        """

    @property
    def lead(self) -> tuple:
        """Leading dimensions."""

    @property
    def size(self) -> int:
        """Their product."""

    @property
    def contacts(self) -> int: ...

    @property
    def joints(self) -> int: ...

    @property
    def jacobian_rows(self) -> int: ...

    @property
    def float32(self) -> bool:
        """Whether no tensor with dimensions is float64."""

    def solve(self, start: int, stop: int, tolerance: float, limit: int, force: object, torsion: object, multipliers: object, facts: object, state: object) -> None:
        """
        Optimal forces of the problems from start to stop into arrays of all of them, see `BatchForces`. Releases the GIL.
        """

    def differentiate(self, start: int, stop: int, state: object, by_force: object | None, by_torsion: object | None, by_multipliers: object | None, elastic: bool, gradients: tuple) -> None:
        """
        Gradients of a loss by the inputs, into arrays or None in their order. Releases the GIL.
        """

FULL_CONTACTS: int = 8

def descend_flow(contacts: Contacts, form: str, rule: object, tolerance: float, limit: int, wrench: object, force: object, optimum: float, trace: object, record: object) -> int:
    """
    A flow from a balanced force (N, 3) inside the cones, into a record; returns the code. rule: (5,) kind, first, grow,
    shrink, decrease, see `step_size.py`; optimum: a known min Phi or nan; trace: (T,) receives Phi of iterates 0..T-1.
    """

def repeat_step(contacts: Contacts, form: str, x: object, times: int) -> float:
    """
    Makes the product step of a flow at x (3N,), cone coordinates, so many times; returns its last number.
    form: full (Eq. 12, up to FULL_CONTACTS), paper (Eq. 26) or reduced, the same in the fewest products.
    """

def limit_rows(least: object, most: object, jacobian: object, torques: object, biases: object, matrix: object, bounds: object, limited: object) -> int:
    """
    Finite limits of normal forces (N,) and, with a Jacobian (N, 4, J), of torques (J,), as rows A f <= b on force and
    torsion: fills A (R, N, 4), b (R,) and what each limit is (R,), R = 2 (N + J), up to the number that it returns.
    """

PLAIN_FEATURES: int = 8

MOST_STAGES: int = 8

WIDEST: int = 1024

class Network:
    """A float32 perceptron with activation v/2 (1 + v / sqrt(1 + v^2))."""

    @staticmethod
    def make(sizes: Sequence[int], weights: object) -> Network:
        """
        sizes: inputs, hidden ..., outputs; weights: of each stage (inputs x outputs), then its bias, flat.
        """

class Model:
    """A trained model on contacts as they are now."""

    @staticmethod
    def make(network: Network, pairs: Network) -> Model:
        """
        pairs: of one stage, makes of a wrench's direction the vectors whose lengths the network reads, too.
        """

    def normalise(self, floor: float, smoothing: float, log_mean: float, log_scale: float, friction_mean: float, friction_scale: float) -> None:
        """Of the network's features, see policies/features.py."""

    def place(self, null_space: object, friction: float, scale: float, largest: float) -> None:
        """
        null_space: (3N, 3N - 6) internal forces that the network's outputs stand for; scale: sqrt(lambda / omega) over that of
        training; largest: size of the training's wrenches [N], < 0: none is covered.
        """

    def save(self) -> bytes:
        """What `grasp::ModelFile` reads: one file for C++ programs."""

    @staticmethod
    def load(bytes: bytes) -> Model | None:
        """The model that `save` wrote; None: it is not whole."""

    def covers(self, wrench: object) -> bool:
        """
        Whether wrench (unit frame), contacts and friction lie in the training range.
        """

    def predict(self, wrench: object, coordinates: object) -> None:
        """
        The internal force that the network predicts for a wrench (unit frame), in coordinates (3N - 6,) [N] of the null space.
        """

def phi(x: object, weights: object) -> float:
    """
    Phi of forces (N, 3) in cone coordinates with weights (N, 2) omega, lambda; inf unless strictly inside every cone.
    """

def phi_gradient(x: object, weights: object, out: object) -> None:
    """Its gradient, into (N, 3)."""

def phi_hessian(x: object, weights: object, out: object) -> None:
    """The 3 x 3 blocks of its Hessian, into (N, 3, 3)."""

def phi_lower_bound(y: object, weights: object) -> float:
    """Least of phi(x) - y . x, contact by contact, y (N, 3); -inf: none."""

class Surface:
    """A surface, body frame; the axis of cylinders and capsules is y."""

    @staticmethod
    def make(kind: str, numbers: object) -> Surface:
        """
        numbers (3,) [m]: cuboid, half its sides; cylinder, radius and half its height; sphere, radius; capsule,
        radius and half its axis.
        """

    @staticmethod
    def mesh(corners: object, faces: object, pieces: Sequence[object]) -> Surface:
        """
        corners (V, 3) [m] and their numbers (F, 3) as float64, from outside counterclockwise, of a closed mesh; corners
        (K, 3) [m] of convex pieces that together hold it.
        """

    def nearest(self, center: object) -> tuple[NDArray, NDArray, float]:
        """
        The nearest point [m], (3,), the INWARD unit normal there and the distance [m], below 0 inside. Where several
        points are as near, one of them; on edges the normal is the direction to them.
        """

REACHED: float = 1e-09

class Link:
    """A link of a hand and the joint that moves it."""

    def __init__(self, *, parent: int, offset: Sequence[float], rotation: Sequence[float], axis: Sequence[float], mass: float, center: Sequence[float], lower: float, upper: float, torque_limit: float, sliding: bool = False, driver: int = -1, ratio: float = 1.0, shift: float = 0.0, inertia: Sequence[float] = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0]) -> None:
        """
        parent: number of the link that carries it, -1: the palm. offset [m], rotation (9,): its joint in the parent's frame.
        axis: of the joint, unit; center: of mass [m], its own frame. Limits [rad], [N m], of a sliding joint [m], [N].
        driver: the joint that it is coupled to, -1: none; its angle is ratio * that of the driver + shift. inertia: xx, xy, xz, yy, yz, zz
        about the centre of mass [kg m^2].
        """

class Tip:
    """The sphere with which a finger touches."""

    def __init__(self, *, link: int, center: Sequence[float], radius: float) -> None:
        """center [m] in the link's frame."""

class Tree:
    """A hand as a tree of M links with N fingertips, never changed."""

    @staticmethod
    def make(links: Sequence[Link], tips: Sequence[Tip]) -> Tree:
        """Parents come before their links."""

    @property
    def joints(self) -> int: ...

    @property
    def fingers(self) -> int: ...

    def couple(self, angles: object) -> None:
        """Puts coupled joints where those that drive them say, in angles (M,)."""

    def trace(self, angles: object, rotations: object, origins: object) -> None:
        """
        Where the links are at angles (M,) [rad], world frame: rotations (M, 3, 3) and origins (M, 3) [m] are filled.
        """

    def tips(self, angles: object, centers: object) -> None:
        """Centres of the fingertips [m], world frame, into (N, 3)."""

    def jacobian(self, angles: object, link: int, place: object, jacobian: object) -> None:
        """
        The velocity of a point (3,) [m] of a link per joint speed, world frame, into (3, M).
        """

    def mass_matrix(self, angles: object, matrix: object) -> None:
        """(M, M) [kg m^2]; rows and columns of coupled joints are zero."""

    def gravity_torques(self, angles: object, gravity: object, torques: object) -> None:
        """
        Torques that carry the weight of all links under a gravity (3,) [m/s^2], into (M,) [N m].
        """

    def statics(self, angles: object, points: object, gravity: object, jacobian: object, torques: object) -> None:
        """
        The Jacobians of the points (N, 3) [m] with which the fingertips touch, into (N, 3, M), and those torques, into (M,).
        """

    def save(self) -> bytes:
        """The bytes of a file for C++ programs, which `grasp::TreeFile` reads."""

    @staticmethod
    def load(bytes: bytes) -> Tree | None:
        """The hand that `save` wrote; None: it is not whole."""

class Reach:
    """
    Inverse kinematics of a hand: damped least squares within the joint limits.
    """

    @staticmethod
    def make(tree: Tree, limited: bool = True) -> Reach:
        """limited: within the joint limits."""

    @property
    def groups(self) -> list[tuple[list[int], list[int]]]:
        """Fingers that share joints, and these joints."""

    def solve(self, targets: object, starts: object, angles: object, missed: object) -> None:
        """
        Brings the tips near to targets (N, 3) [m], from starts (S, M) in this order: fills angles (M,) [rad], and (G,) what
        the worst tip of each group misses [m].
        """

class Limb:
    """A convex shape that is fixed to a link; -1: to the palm."""

    @staticmethod
    def line(*, link: int, start: Sequence[float], end: Sequence[float], radius: float, tip: bool) -> Limb:
        """
        All within a radius of a line [m], link frame; tip: part of a fingertip.
        """

    @staticmethod
    def solid(*, link: int, kind: str, half: Sequence[float], center: Sequence[float], rotation: Sequence[float], corners: object, tip: bool) -> Limb:
        """
        kind: box, half its sides; cylinder about z, radius twice and half its height; hull, (K, 3) corners about a
        point inside [m]. center [m] and rotation (9,), link frame.
        """

class HandLimbs:
    """The limbs of a hand, and its fingers one by one."""

    @staticmethod
    def make(tree: Tree, limbs: Sequence[Limb], home: object, together: Sequence[tuple[int, int]] = []) -> HandLimbs:
        """
        home (M,) [rad]: where the inverse kinematics starts; together: pairs of links, -1 the palm, that may touch.
        """

    def moved(self, turn: Sequence[float], shift: Sequence[float], home: object) -> HandLimbs:
        """
        The same hand, its palm turned (9,), then shifted [m], with another rest posture (M,).
        """

    def clearance(self, surface: Surface, angles: object, enough: float = float('inf')) -> tuple[float, float]:
        """
        Least distances [m] at angles (M,): of the links, without spheres of fingertips, from an object; of links and tips from one
        another; at most `enough`.
        """

    def link_gaps(self, angles: object, enough: float) -> list[tuple[int, int, float]]:
        """
        Pairs of limbs of different links, not of one joint, that are at most `enough` apart [m]: (link, link, distance). Coupled
        joints follow theirs.
        """

    def beside(self, finger: int, angles: object, middles: object, enough: float, gaps: object) -> None:
        """
        How far the rest of a finger and the palm are from balls about `middles` (K, 3) that touch its tip in postures (K, M),
        at most `enough` [m]: into (K,).
        """

    @property
    def free(self) -> list[bool]:
        """Of each finger, whether its tip goes anywhere near."""

    def palm_gap(self, surface: Surface) -> float:
        """Of the palm from an object [m]."""

class GraspSearch:
    """A search for contacts with which a hand holds an object."""

    @staticmethod
    def make(hand: HandLimbs, surface: Surface, *, friction: float, torsion: float, length: float, space: float, start: float, gravity: Sequence[float], loads: object, directions: object) -> GraspSearch:
        """
        loads: (L, 6) that the contacts make, (force, moment / length) [N]; directions: (D, 6) to compare them in;
        length, space between fingers, torsion: moment about the normal over its force, start: of the tips from the
        object before they close [m]; gravity (3,) [m/s^2].
        """

    def fill(self, finger: int, draws: object, spread: Sequence[float], margins: Sequence[float], most: int) -> int:
        """
        Makes the pool of places of a finger anew, and returns their number.
        draws: (S, 6) in [0, 1); less 1/2, times spread (6,): where to begin inside the object [m], and what to add to the
        direction towards the finger.
        margins: [m] of flat surface, [rad] from joint limits, [m] of clearance, [m] of a mesh's pieces over it at most.
        """

    def choose(self, picks: Sequence[Sequence[int]], forces: object, points: object, normals: object, choices: object) -> int:
        """
        The best choice of each round: the total normal force [N] that it needs in the worst case into (R,), points and
        normals into (R, N, 3), places into (R, N); returns how many. picks: random numbers >= 0 per finger, of the choices to begin with.
        """

    def misses(self, finger: int) -> list[int]:
        """
        How many rays ended at an edge, out of reach, near a joint's limit, with a link at the object, without room to start,
        without push along the normal.
        """

    def assemble(self, choice: Sequence[int], clearance: float, angles: object, start: object) -> int:
        """
        Angles (M,) of the whole hand at a choice of places, and before it closes, as far as they are. Returns 0, or what is
        wrong: 1 a link nearer to the object than `clearance` [m], 2 links touch, 3 no start, 4 and 5 as 1 and 2 at the start,
        6 fingers of one motor do not touch together.
        """

class Answers:
    """
    Where the numbers lie in the nested tuples that a simulator answers with.
    """

    def __init__(self, *, link: int, place: int, forces: Sequence[tuple[int, int]], factor: float, first: int, links: Sequence[int]) -> None:
        """
        Of a contact: which item is the engine's link number, which the point, which pairs are amounts and directions of
        forces; factor of all amounts, below 0 where they push the hand. links: the hand's link of each of the
        engine's, from number `first` on, -1: none.
        """

    def read(self, joints: object, pose: object, velocity: object, contacts: object) -> numpy.typing.NDArray[numpy.float64]:
        """
        Joints ((angle, rate, ...), ...), pose (position, quaternion), velocity (linear, angular) and contacts as the flat
        numbers of `Scene.read`, a new array.
        """

def reading_size(joints: int, contacts: int) -> int:
    """Numbers of a reading."""

class Scene:
    """A hand and an object in a simulator, as they were last read."""

    @staticmethod
    def make(tree: Tree, surface: Surface, gravity: Sequence[float]) -> Scene: ...

    def set_gravity(self, gravity: Sequence[float]) -> None:
        """[m/s^2], (3,), world frame."""

    def read(self, numbers: object) -> bool:
        """
        Angles (M,), rates (M,), the object's position, quaternion (x y z w), linear and angular velocity, and seven numbers
        a contact: the hand's link, the point [m] and the force ON the object [N]; world frame. False: not finite, or the
        object is lost.
        """

    def arrays(self) -> dict[str, NDArray]:
        """Views of what follows from it, by name: overwritten at each reading."""

class Gather:
    """Numbers that lie in several arrays, clipped, as one new float32 array."""

    def __init__(self, arrays: Sequence[Annotated[NDArray[numpy.float64], dict(order='C', device='cpu', writable=False)]], bound: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> None:
        """
        C-contiguous float64 arrays, which are read at each call, and a float32 bound for each of their numbers.
        """

    def __call__(self) -> numpy.typing.NDArray[numpy.float32]: ...

class Body:
    """The object as a controller believes it to be, and the pose feedback."""

    def __init__(self) -> None: ...

    @property
    def mass(self) -> float:
        """[kg]"""

    @mass.setter
    def mass(self, arg: float, /) -> None: ...

    @property
    def inertia(self) -> list[float]:
        """(9,) [kg m^2] about its centre, object frame"""

    @inertia.setter
    def inertia(self, arg: Sequence[float], /) -> None: ...

    @property
    def position_gain(self) -> float:
        """[N/m]"""

    @position_gain.setter
    def position_gain(self, arg: float, /) -> None: ...

    @property
    def position_damping(self) -> float:
        """[N s/m]"""

    @position_damping.setter
    def position_damping(self, arg: float, /) -> None: ...

    @property
    def rotation_gain(self) -> float:
        """[1/s^2], times the inertia"""

    @rotation_gain.setter
    def rotation_gain(self, arg: float, /) -> None: ...

    @property
    def rotation_damping(self) -> float:
        """[1/s], times the inertia"""

    @rotation_damping.setter
    def rotation_damping(self, arg: float, /) -> None: ...

    def wrench(self, scene: Scene, target: object, gravity: object) -> list[float]:
        """
        Weight - inertial wrench of the wanted motion + pose feedback (6,) [N, N m], object frame.
        """

class Spring:
    """Of a tip that is drawn to its place."""

    def __init__(self, gain: float, damping: float, limit: float) -> None:
        """[N/m], [N s/m], the most force [N]"""

class WrenchSource(enum.Enum):
    """How the controller knows the external wrench."""

    measured = 0

    estimated = 1

    none = 2

class Hold(enum.Enum):
    """What the fingers in contact do."""

    optimized = 0
    """the force that the method finds, and Newton after it"""

    squeeze = 1
    """a constant internal force, and what balances"""

    place = 2
    """no force: every finger holds its place"""

    direct = 3
    """given forces"""

    reach = 4
    """no force: every finger is drawn to its contact"""

class ControlSettings:
    """Belief and gains of a control loop."""

    def __init__(self) -> None: ...

    @property
    def body(self) -> Body: ...

    @body.setter
    def body(self, arg: Body, /) -> None: ...

    @property
    def reach(self) -> list[Spring]:
        """(N,) of each finger without contact on its way"""

    @reach.setter
    def reach(self, arg: Sequence[Spring], /) -> None: ...

    @property
    def spring(self) -> Spring:
        """of all fingers where nothing is optimized"""

    @spring.setter
    def spring(self, arg: Spring, /) -> None: ...

    @property
    def reach_depth(self) -> float:
        """[m] inside the surface to which a finger reaches"""

    @reach_depth.setter
    def reach_depth(self, arg: float, /) -> None: ...

    @property
    def posture(self) -> list[Spring]:
        """(M,) of joints that the tips leave free [N m/rad], [N m s/rad]"""

    @posture.setter
    def posture(self, arg: Sequence[Spring], /) -> None: ...

    def set_follow(self, tolerance: float, limit: int, conic: bool = False) -> None:
        """
        What solves between two ticks of the method, Newton or conic: relative certified gap, most steps.
        """

    @property
    def remembers(self) -> bool:
        """whether the method receives the last command"""

    @remembers.setter
    def remembers(self, arg: bool, /) -> None: ...

    @property
    def directions(self) -> list[float]:
        """(N, 3, K) internal forces of an adjustment, object frame"""

    @directions.setter
    def directions(self, arg: Sequence[float], /) -> None: ...

    @property
    def squeeze(self) -> float:
        """[N] total normal force of `Hold.squeeze`"""

    @squeeze.setter
    def squeeze(self, arg: float, /) -> None: ...

    @property
    def most_change(self) -> float:
        """[N] by which a force may change in a tick beyond balance"""

    @most_change.setter
    def most_change(self, arg: float, /) -> None: ...

    @property
    def release(self) -> int:
        """ticks without force after which a finger is no longer in contact"""

    @release.setter
    def release(self, arg: int, /) -> None: ...

class SensorSettings:
    """What the controller sees: how late, how noisy."""

    def __init__(self) -> None: ...

    @property
    def wrench(self) -> WrenchSource: ...

    @wrench.setter
    def wrench(self, arg: WrenchSource, /) -> None: ...

    @property
    def tick(self) -> float:
        """[s]"""

    @tick.setter
    def tick(self, arg: float, /) -> None: ...

    @property
    def keep(self) -> float:
        """share of its last value that the estimate keeps over a tick"""

    @keep.setter
    def keep(self, arg: float, /) -> None: ...

    @property
    def delay(self) -> int:
        """ticks by which everything comes late"""

    @delay.setter
    def delay(self, arg: int, /) -> None: ...

    @property
    def wrench_delay(self) -> int:
        """ticks by which measured wrenches come later than that"""

    @wrench_delay.setter
    def wrench_delay(self, arg: int, /) -> None: ...

    @property
    def pose_noise(self) -> float:
        """standard deviation per axis [m]"""

    @pose_noise.setter
    def pose_noise(self, arg: float, /) -> None: ...

    @property
    def tactile_noise(self) -> float:
        """standard deviation per axis, part of the force"""

    @tactile_noise.setter
    def tactile_noise(self, arg: float, /) -> None: ...

class Effort:
    """What solvers and motors were asked since `begin_step`."""

    @property
    def iterations(self) -> int:
        """accepted steps of the method"""

    @property
    def trials(self) -> int:
        """all steps of the method"""

    @property
    def followed(self) -> int:
        """iterations at control ticks between two of the method's"""

    @property
    def limited(self) -> int:
        """
        iterations of Newton within the torque limits, where a force exceeded them
        """

    @property
    def saturated(self) -> bool:
        """whether torques had to be cut"""

    @property
    def margin(self) -> float:
        """least distance of a torque from its limit [N m]"""

    @property
    def share(self) -> float:
        """largest torque as a share of its limit"""

class Costs:
    """Costs of an agent's step, each from 0 to 1."""

    @property
    def force(self) -> float:
        """
        share of the commanded normal forces above the least that balances the wrench; 1: no force balances it
        """

    @property
    def torque(self) -> float:
        """largest torque of the step as a share of its limit"""

    @property
    def change(self) -> float:
        """
        change of the commanded forces in the step as a share of the forces before and after: sums of |components|
        """

class Outcome:
    """How the object is held."""

    @property
    def drift(self) -> float:
        """[m] from where it should be"""

    @property
    def tilt(self) -> float:
        """[rad] from how it should stand"""

    @property
    def force_error(self) -> float:
        """largest component of measured - commanded force [N]"""

    @property
    def slip(self) -> float:
        """fastest touching tip on the object [m/s]"""

    @property
    def stray(self) -> float:
        """force of links on the object [N]"""

    @property
    def slide(self) -> float:
        """
        the furthest since `reset` that a touching tip has slid from where it was on the object [m]
        """

    @property
    def overlap(self) -> float:
        """the deepest since `reset` of a tip and the object [m]"""

    @property
    def stray_share(self) -> float:
        """
        the largest force of links on the object since `reset`, as a share of external force and weight,
        the weight at least
        """

class Controller:
    """The control loop of a hand: what it sees, and the torques that hold."""

    @staticmethod
    def make(scene: Scene, optimizer: object, settings: ControlSettings, sensors: SensorSettings) -> Controller:
        """
        optimizer: a `ForceOptimizer` for the contacts of all fingers, which is copied.
        """

    def reset(self) -> None:
        """Forgets the episode; before it the scene stood still."""

    def rewind(self) -> None:
        """As before the first tick: what was seen was not yet."""

    def tick(self, reading: object | None, external: object, gravity: object, target: object, noise: object | None, due: bool, adjustment: object | None, given: object | None) -> list[float] | None:
        """
        Joint torques (M,) [N m] of a control tick; None: the reading is not finite or the object is lost. reading: as of
        `Scene.read`, None: the scene has it already; external: the wrench (6,) as a perfect sensor would tell it; gravity
        (3,); target (19,); noise: standard normal numbers (3 + 3N,) where anything is noisy. due: whether an agent's step
        begins, with adjustment (K,) [N] of the start and given forces (N, 3) [N], contact frames, for `Hold.direct`.
        """

    def see(self, reading: object | None, external: object, gravity: object, target: object, noise: object | None) -> bool:
        """The first half of a tick: what is known, and the wrench to balance."""

    def act(self, due: bool, adjustment: object | None, start: object | None, given: object | None) -> list[float]:
        """
        The second half. start: (N, 3) [N], contact frames, from where the method begins.
        """

    @property
    def hold(self) -> Hold:
        """What the fingers in contact do."""

    @hold.setter
    def hold(self, arg: Hold, /) -> None: ...

    def begin_step(self) -> None:
        """An agent's step begins."""

    @property
    def effort(self) -> Effort: ...

    def costs(self) -> Costs:
        """
        The costs of the step since `begin_step`, on the contacts that are seen now.
        """

    @property
    def code(self) -> int:
        """How the method's last solve ended."""

    @property
    def closure(self) -> bool:
        """Whether a force was found at the last tick that optimized."""

    def rest(self) -> None:
        """Measured forces as the commanded ones: what the hand does at rest."""

    def outcome(self, target: object, error: object, measured: object) -> Outcome:
        """
        How the object is held, by the truth: fills the pose error (12,) against a target (19,), and the measured forces
        (N, 3) in the commanded contact frames [N].
        """

    def told(self, outcome: Outcome, measured: object) -> dict[str, object]:
        """
        What an environment reports of a step, by name: the method's solution, contacts, forces [N], effort, and an outcome with its
        measured forces (N, 3); the arrays are copies.
        """

    def arrays(self) -> dict[str, NDArray]:
        """Views of what is commanded, by name: overwritten in place."""

    def seen(self) -> dict[str, NDArray]:
        """Views of what is seen, by name: overwritten in place."""

    @property
    def perfect(self) -> bool:
        """Whether the scene is seen as it is, whatever the settings."""

    @perfect.setter
    def perfect(self, arg: bool, /) -> None: ...

    @property
    def exact(self) -> bool:
        """Whether the scene is seen as it is."""

    @property
    def mask(self) -> int:
        """The fingers that count as in contact: 2^i for finger i."""

    @property
    def changes(self) -> int:
        """How often they changed since `reset`."""

    @property
    def peak(self) -> float:
        """Largest torque since `reset` [N m]."""
