"""The arm controller of LIBERO: operational-space control of robosuite 1.4 (OSC_POSE), Khatib 1987, in MuJoCo alone."""

from __future__ import annotations

import mujoco
import numpy as np

from vla.spec import Array

# robosuite/controllers/config/osc_pose.json, robosuite/models/grippers/panda_gripper.py, and for the posture, which
# differs from robosuite's, libero/envs/robots/mounted_panda.py
HOME = np.array([0, -0.161037389, 0, -2.44459747, 0, 2.2267522, np.pi / 4])  # reference posture of the null space [rad]
STIFFNESS, POSTURE = 150.0, 10.0  # of the hand and of the null space [1/s²]; both damped critically
DAMPING, POSTURE_DAMPING = 2 * np.sqrt(STIFFNESS), 2 * np.sqrt(POSTURE)
REACH = np.array([0.05] * 3 + [0.5] * 3)  # of a full command [m, rad]
SUBSTEPS = 25  # of 2 ms
GRIPPER_RATE = 0.01  # of the range -1…1 per substep: eight actions from open to closed


class Controller:
    """Computes torques from an action, anew in every substep.

    A goal is relative to the hand's current pose, not to the previous goal, so displacements do not accumulate; an
    action without rotation keeps the goal's rotation. Only the sign of the gripper command counts: its speed is fixed.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """Take the model of a scene."""
        self._model = model
        joint = model.joint("robot0_joint1")  # of seven in a row
        self._qpos = slice(joint.qposadr[0], joint.qposadr[0] + 7)
        self._arm = slice(joint.dofadr[0], joint.dofadr[0] + 7)
        self.site = model.site("gripper0_grip_site").id
        motor, finger = (model.actuator(f"{name}1").id for name in ("robot0_torq_j", "gripper0_gripper_finger_joint"))
        self._motors, self._fingers = slice(motor, motor + 7), slice(finger, finger + 2)
        self._low, self._high = model.actuator_ctrlrange[self._motors].T
        low, high = model.actuator_ctrlrange[self._fingers].T
        self._middle, self._half = (low + high) / 2, (high - low) / 2 * (1, -1)
        self._home = mujoco.MjData(model)
        self._home.qpos[self._qpos] = HOME
        mujoco.mj_forward(model, self._home)
        self._jacobian, self._mass = np.zeros((6, model.nv)), np.zeros((model.nv, model.nv))
        self.reset()

    def reset(self) -> None:
        """Start an episode.

        LIBERO's controller does not notice that an initial state replaces the home posture: the first goal is relative
        to the hand in that posture, the first torque is computed there, and its rotation is held until an action turns.
        """
        self._rotation_goal = self._home.site_xmat[self.site].reshape(3, 3).copy()
        self._goal = self._home.site_xpos[self.site].copy()
        self.opening = 0.0  # commanded, 1 open and -1 closed: LIBERO starts half open
        self._unnoticed = True

    def step(self, data: mujoco.MjData, action: Array) -> None:
        """Apply an action (7,) of -1…1 for 50 ms: displacement and rotation vector in the world, gripper (1 closes)."""
        move, closing = np.clip(action[:6], -1, 1) * REACH, GRIPPER_RATE * float(np.sign(action[6]))
        for substep in range(SUBSTEPS):
            mujoco.mj_step1(self._model, data)
            state = self._home if self._unnoticed else data
            if substep == 0:
                self._goal = state.site_xpos[self.site] + move[:3]
                if move[3:].any():
                    self._rotation_goal = rotation(move[3:]) @ state.site_xmat[self.site].reshape(3, 3)
            torques = self._torques(state) + data.qfrc_bias[self._arm]
            self._unnoticed = False
            np.clip(torques, self._low, self._high, out=data.ctrl[self._motors])
            self.opening = min(max(self.opening - closing, -1.0), 1.0)
            data.ctrl[self._fingers] = self._middle + self._half * self.opening
            mujoco.mj_step2(self._model, data)

    def _torques(self, data: mujoco.MjData) -> Array:
        """Return the motors' torques (7,) [N m] without the compensation of gravity and Coriolis forces."""
        arm = self._arm
        mujoco.mj_jacSite(self._model, data, self._jacobian[:3], self._jacobian[3:], self.site)
        mujoco.mj_fullM(self._model, data, self._mass)
        jacobian, mass = self._jacobian[:, arm], self._mass[arm, arm]
        orientation = data.site_xmat[self.site].reshape(3, 3)
        error = np.empty(6)
        error[:3] = self._goal - data.site_xpos[self.site]
        error[3:] = 0.5 * np.cross(orientation, self._rotation_goal, axis=0).sum(axis=1)
        acceleration = STIFFNESS * error - DAMPING * (jacobian @ data.qvel[arm])
        compliance = jacobian @ np.linalg.solve(mass, jacobian.T)  # (6, 6), inverse of the hand's inertia
        force = np.empty(6)  # position and rotation each by its own block, as robosuite's `uncouple_pos_ori`
        force[:3] = np.linalg.solve(compliance[:3, :3], acceleration[:3])
        force[3:] = np.linalg.solve(compliance[3:, 3:], acceleration[3:])
        posture = POSTURE * (HOME - data.qpos[self._qpos]) - POSTURE_DAMPING * data.qvel[arm]
        force -= np.linalg.solve(compliance, jacobian @ posture)  # the posture must not move the hand
        return jacobian.T @ force + mass @ posture


def rotation(vector: Array) -> Array:
    """Return the matrix (3, 3) of a rotation vector (3,) [rad]."""
    angle = float(np.linalg.norm(vector))
    quaternion, matrix = np.empty(4), np.empty(9)
    mujoco.mju_axisAngle2Quat(quaternion, vector / max(angle, 1e-12), angle)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)
