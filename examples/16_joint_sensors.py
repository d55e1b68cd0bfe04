"""
With joint sensors alone
========================

An Allegro holds a ball in MuJoCo for a minute with joint angles, rates and motor torques alone. Its
contacts come from ``ContactEstimator``, with normals that are guessed once. The wrench to balance is
a mean of what the estimated forces resist. Meanwhile the ball is pushed, torques have noise of 5 %,
and a finger is pulled off every three seconds. To learn: contacts without tactile sensors, weighing
with the fingers, and what joint torques do not tell. A pull at a finger looks like contact, so the
estimator sees none of these losses, and the preloads of the other fingers must cover them.
"""

import matplotlib.pyplot as plt
import numpy as np

from grasp_env.control import ContactEstimator, HandController, HandControllerSettings
from grasp_env.env.env import FourFingerGrasp
from grasp_env.sim import HandDescription, MujocoEngine

SECONDS = 60
RATE = 500  # [Hz]
MEAN = 0.1  # [s] of the wrench
PULL, PUSH = 3.0, 0.7  # [N] at a finger for 0.1 s; at the ball, per axis
JOINT_FRICTION = 0.0  # [N m] of the simulated joints

# the simulator closes the hand around a ball of 60 mm
ball = {"shape": "sphere", "size": (0.06,), "mass": 0.15, "friction": 0.7}
rates = {"controller.rate": RATE, "agent.rate": RATE // 10}
env = FourFingerGrasp(hand=HandDescription.allegro(), engine=MujocoEngine(), **ball, **rates)
env.reset(seed=0)
scene = env.scene
hand = scene.config.hand
scene.set_joint_friction(JOINT_FRICTION)
pulls = scene.simulator.data.xfrc_applied
bodies = [scene.simulator.model.body(f"link{link}").id for link in scene.kinematics.tip_links]

# all that the hand knows of the ball: its centre when the fingers close
truth = scene.look()
center = truth.position.copy()
inward = center - truth.tips
inward /= np.linalg.norm(inward, axis=1, keepdims=True)
estimator = ContactEstimator(hand, normals=inward)
controller = HandController()
settings = HandControllerSettings(rate=RATE, friction=0.7, friction_margin=0.6, preload=1.5)
controller.configure(hand, settings)
state = controller.new_state()  # `object` and `target` stay as they are
state.gravity = scene.gravity
state.angles = truth.angles
state.positions, state.normals, _ = scene.kinematics.contacts(truth.angles, normals=inward)
state.touching[:] = 1.0
state.wrench[:3] = 0.1 * scene.gravity  # a guess: 100 g
controller.activate(state)
for _ in range(RATE // 20):  # torques rise while the simulator waits
    torques = controller.update(state, 1 / RATE)

rng = np.random.default_rng(0)
times = np.arange(SECONDS * RATE) / RATE
drift = np.empty(len(times))  # [mm]
weight = np.empty(len(times))  # [N]
errors = np.empty((len(times), 4))  # [N]
seen, real = np.empty((2, len(times), 4), dtype=bool)
for tick, now in enumerate(times):
    if tick % 2 == 0:  # noise lasts for 4 ms
        noise = 1.0 + 0.05 * rng.standard_normal(16)
    pulls[bodies] = 0.0
    if now > 3.0 and now % 3.0 < 0.1:
        finger = int(now / 3.0) % 4
        pulls[bodies[finger], :3] = -PULL * inward[finger]
    push = PUSH * np.sin(1.6 * now * np.array([1.0, 0.7, 1.3])) * (now > 2.0)
    scene.step(torques * noise, [*(truth.rotation.T @ push), 0.0, 0.0, 0.0])

    truth = scene.look()
    state.angles = truth.angles
    state.rates = truth.rates
    estimator.update(state, torques, 1 / RATE)
    forces = estimator.forces
    moment = np.cross(state.positions, forces).sum(axis=0)
    resisted = np.concatenate([forces.sum(axis=0), moment])
    state.wrench -= (state.wrench + resisted) / (MEAN * RATE)
    torques = controller.update(state, 1 / RATE)

    weight[tick] = resisted[1]  # gravity is along -y
    drift[tick] = 1e3 * np.linalg.norm(truth.position - center)
    errors[tick] = np.linalg.norm(forces - truth.forces @ truth.rotation.T, axis=1)
    seen[tick] = state.touching
    real[tick] = truth.touching
env.close()

mass = 1e3 * weight[(times > 1.0) & (times < 2.0)].mean() / 9.81
quiet = errors[times % 3.0 > 0.5]
lost, noticed = (int((touch[:-1] & ~touch[1:]).sum()) for touch in (real, seen))
print(f"the ball moved by at most {drift.max():.2f} mm; it weighs {mass:.1f} g, 150 g are true")
print(f"contacts were lost {lost} times, and the estimator saw {noticed} of these losses")
print(
    f"false touches: {(seen & ~real).mean():.2%}, missed: {(real & ~seen).mean():.2%} of the time"
)
print(f"force errors: {np.median(quiet):.2f} N (median), {np.quantile(quiet, 0.99):.2f} N (99 %)")
assert drift.max() < 5.0
assert abs(mass - 150.0) < 10.0

plt.figure(figsize=(8, 4.5), layout="constrained")
plt.plot(times, drift)
plt.xlabel("time [s]")
plt.ylabel("drift of the ball [mm]")
plt.show()
