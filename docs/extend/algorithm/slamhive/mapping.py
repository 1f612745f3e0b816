"""Dead reckoning: integrate angular rates and accelerations of an IMU that starts at rest."""

import sys

import numpy as np

from slamhive.runtime.app import run
from slamhive.runtime.trajectory import Poses


class DeadReckoning:
    """One pose for each frame of the camera."""

    def __init__(self, config):
        self.rest_s = config.parameters["rest_s"]
        self.stamps_s, self.samples = [], []

    def process(self, frame):
        """Keep what came in: (n, 7) time, angular rate, acceleration."""
        self.stamps_s.append(frame.stamp_s)
        self.samples.append(frame.imu)

    def finish(self):
        """Integrate, and give the poses at the times of the frames."""
        times_s, rates, forces = np.split(np.vstack(self.samples), [1, 4], axis=1)
        times_s = times_s[:, 0]
        resting = times_s < times_s[0] + self.rest_s
        up = forces[resting].mean(axis=0)
        rates = rates - rates[resting].mean(axis=0)
        rotation, velocity, position = level(up), np.zeros(3), np.zeros(3)
        poses = np.tile(np.eye(4), (len(times_s), 1, 1))
        for index, step_s in enumerate(np.diff(times_s, prepend=times_s[0])):
            rotation = rotation @ turn(rates[index] * step_s)
            if not resting[index]:
                velocity = velocity + (rotation @ forces[index] - [0, 0, np.linalg.norm(up)]) * step_s
            position = position + velocity * step_s
            poses[index, :3, :3], poses[index, :3, 3] = rotation, position
        nearest = np.minimum(np.searchsorted(times_s, self.stamps_s), len(times_s) - 1)
        return Poses(times_s[nearest], poses[nearest])

    def about(self):
        """Facts about the program for the record of the run."""
        return {"package": "dead-reckoning", "version": "1.0.0"}


def turn(vector):
    """The rotation matrix of a rotation vector in rad (Rodrigues)."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def level(up):
    """The rotation from the IMU's frame to one whose z axis points up."""
    z = up / np.linalg.norm(up)
    x = np.cross([0, 1, 0], z)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


if __name__ == "__main__":
    sys.exit(run(DeadReckoning))
