"""The collinearity equations of one image point: weighted residual and derivatives.

    (U, V, W) = M (X - X0),  u = -U/W,  v = -V/W,  r = model(u, v, p) - measured

Models that reach beyond 90 degrees from the axis take stereographic coordinates, u = 2 U/(L - W) and
v = 2 V/(L - W) with the distance L of the point, in place of the tangents.

The unknowns of a photograph are its projection centre X0 and a small rotation w in its image axes,
R <- R exp([w]x). Then d(U, V, W)/dw = [(U, V, W)]x, and no angle becomes singular.

Source: Kraus, Photogrammetry (2007), sec. 5.3; small rotations as in Foerstner and Wrobel (2016),
sec. 8.1 and 12.2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sfm.model.conventions import BoolArray, FloatArray, IntArray
from sfm.model.distortion.models import MAX_PARAMETERS, observe
from sfm.runtime.compiling import compiled, inlined, kernel

CAMERA_UNKNOWNS = MAX_PARAMETERS + 6  # interior parameters and the mount of a camera


class Observations(NamedTuple):
    """Image points in the order of their object points, in the form that compiled code uses."""

    start: IntArray  # first image point of each object point, and the end, (n + 1,)
    image: IntArray  # photograph of each image point, (k,)
    point: IntArray  # object point of each image point, (k,)
    xy: FloatArray  # measured pixel, px, (k, 2)
    whitening: FloatArray  # a, b, c of F = (a 0; b c) with F'F = inverse covariance, 1/px, (k, 3)
    share: FloatArray  # factor on the weight of each image point by its source, (k,)
    camera: IntArray  # camera of each photograph, (m,)
    pose: IntArray  # pose of each image point, that of its photograph or of its rig, (k,)
    pose_of: IntArray  # pose of each photograph, (m,)
    poses: int  # number of poses
    mounted: BoolArray  # cameras of rigs other than the reference cameras, (a,)
    model: IntArray  # number of the distortion model of each camera, (a,)
    frame: (
        FloatArray  # centre (px), pixel size (mm), planes of residuals, affinity and rays of cameras, (a, 7)
    )
    interior: IntArray  # number of parameters in the model of each camera, 0 if none is free, (a,)
    free_count: IntArray  # number of free parameters of each camera and its mount, (a,)
    free_index: IntArray  # their indices; those of the mount start at MAX_PARAMETERS, (a, CAMERA_UNKNOWNS)
    free_column: IntArray  # their columns among the reduced unknowns, (a, CAMERA_UNKNOWNS)


class State(NamedTuple):
    """Values of all parameters, in the form that compiled code uses."""

    position: FloatArray  # X0, (m, 3)
    M: FloatArray  # object to image axes, (m, 3, 3)
    parameters: FloatArray  # interior orientation, (a, MAX_PARAMETERS)
    points: FloatArray  # X, (n, 3)
    pose_position: FloatArray  # X0 of each pose; the same array as `position` without rigs, (poses, 3)
    rig_from_object: FloatArray  # object axes to the axes of each pose, (poses, 3, 3)
    mount_position: FloatArray  # X0 of each camera in the axes of its rig, (a, 3)
    camera_from_rig: FloatArray  # rig axes to the image axes of each camera, (a, 3, 3)


class Workspace(NamedTuple):
    """Work space for one image point in compiled functions."""

    r: FloatArray  # weighted residual, (2,)
    Ju: FloatArray  # d r / d (u, v), px, (2, 2)
    Jp: FloatArray  # d r / d all interior parameters, (2, MAX_PARAMETERS)
    A: FloatArray  # weighted d r / d (X0, w of the pose, interior parameters, X, w of the mount),
    # (2, 6 + CAMERA_UNKNOWNS)
    B: FloatArray  # weighted d r / d X, (2, 3)


@inlined
def new_workspace() -> Workspace:
    """Return a work space for one image point."""
    return Workspace(
        np.empty(2),
        np.empty((2, 2)),
        np.zeros((2, MAX_PARAMETERS)),
        np.zeros((2, 6 + CAMERA_UNKNOWNS)),
        np.empty((2, 3)),
    )


@inlined
def collinearity(
    o: int, observations: Observations, state: State, weight: float, workspace: Workspace
) -> bool:
    """Fill the weighted residual and derivatives of image point o; False if its camera does not see it.

    Args:
        o: index of the image point.
        observations: image points.
        state: values of all parameters.
        weight: factor on the weight of the image point.
        workspace: receives residual and derivatives.
    """
    i, j = observations.image[o], observations.point[o]
    a = observations.camera[i]
    if observations.frame[a, 6] > 0.0:
        return _of_direction(o, observations, state, weight, workspace)
    m00, m01, m02 = state.M[i, 0, 0], state.M[i, 0, 1], state.M[i, 0, 2]
    m10, m11, m12 = state.M[i, 1, 0], state.M[i, 1, 1], state.M[i, 1, 2]
    m20, m21, m22 = state.M[i, 2, 0], state.M[i, 2, 1], state.M[i, 2, 2]
    dX = state.points[j, 0] - state.position[i, 0]
    dY = state.points[j, 1] - state.position[i, 1]
    dZ = state.points[j, 2] - state.position[i, 2]
    U = m00 * dX + m01 * dY + m02 * dZ
    V = m10 * dX + m11 * dY + m12 * dZ
    W = m20 * dX + m21 * dY + m22 * dZ
    inverse = -1.0 / W
    u, v = U * inverse, V * inverse
    observe(
        observations.model[a],
        observations.frame[a],
        state.parameters[a],
        observations.xy[o, 0],
        observations.xy[o, 1],
        u,
        v,
        workspace.r,
        workspace.Ju,
        workspace.Jp,
    )
    root = np.sqrt(weight * observations.share[o])
    f00, f10, f11 = (
        root * observations.whitening[o, 0],
        root * observations.whitening[o, 1],
        root * observations.whitening[o, 2],
    )
    workspace.r[1] = f10 * workspace.r[0] + f11 * workspace.r[1]
    workspace.r[0] = f00 * workspace.r[0]
    # weighted d r / d (U, V, W): du/d(U, V, W) = -(1, 0, u)/W because u = -U/W
    xU, xV = f00 * workspace.Ju[0, 0] * inverse, f00 * workspace.Ju[0, 1] * inverse
    yU = (f10 * workspace.Ju[0, 0] + f11 * workspace.Ju[1, 0]) * inverse
    yV = (f10 * workspace.Ju[0, 1] + f11 * workspace.Ju[1, 1]) * inverse
    xW, yW = xU * u + xV * v, yU * u + yV * v
    # d (U, V, W)/d X = M = -d (U, V, W)/d X0
    workspace.B[0, 0] = xU * m00 + xV * m10 + xW * m20
    workspace.B[0, 1] = xU * m01 + xV * m11 + xW * m21
    workspace.B[0, 2] = xU * m02 + xV * m12 + xW * m22
    workspace.B[1, 0] = yU * m00 + yV * m10 + yW * m20
    workspace.B[1, 1] = yU * m01 + yV * m11 + yW * m21
    workspace.B[1, 2] = yU * m02 + yV * m12 + yW * m22
    for b in range(3):
        workspace.A[0, b] = -workspace.B[0, b]
        workspace.A[1, b] = -workspace.B[1, b]
    # d (U, V, W)/d w = [(U, V, W)]x
    workspace.A[0, 3], workspace.A[1, 3] = xV * W - xW * V, yV * W - yW * V
    workspace.A[0, 4], workspace.A[1, 4] = xW * U - xU * W, yW * U - yU * W
    workspace.A[0, 5], workspace.A[1, 5] = xU * V - xV * U, yU * V - yV * U
    for s in range(observations.interior[a]):  # all parameters: selecting the free ones here would cost more
        workspace.A[0, 6 + s] = f00 * workspace.Jp[0, s]
        workspace.A[1, 6 + s] = f10 * workspace.Jp[0, s] + f11 * workspace.Jp[1, s]
    if observations.mounted[a]:
        _of_rig(a, observations.pose_of[i], state, workspace.A)
    seen: bool = W < 0.0
    return seen


@kernel
def _of_direction(
    o: int, observations: Observations, state: State, weight: float, workspace: Workspace
) -> bool:
    """Fill what `collinearity` does for a model that takes stereographic coordinates.

    It is a function of its own so that the compiler rounds the equations of tangents as ever.
    """
    i, j = observations.image[o], observations.point[o]
    a = observations.camera[i]
    M = state.M[i]
    dX = state.points[j, 0] - state.position[i, 0]
    dY = state.points[j, 1] - state.position[i, 1]
    dZ = state.points[j, 2] - state.position[i, 2]
    U = M[0, 0] * dX + M[0, 1] * dY + M[0, 2] * dZ
    V = M[1, 0] * dX + M[1, 1] * dY + M[1, 2] * dZ
    W = M[2, 0] * dX + M[2, 1] * dY + M[2, 2] * dZ
    L = np.sqrt(U * U + V * V + W * W)
    inverse = 2.0 / (L - W)
    u, v = U * inverse, V * inverse
    observe(
        observations.model[a],
        observations.frame[a],
        state.parameters[a],
        observations.xy[o, 0],
        observations.xy[o, 1],
        u,
        v,
        workspace.r,
        workspace.Ju,
        workspace.Jp,
    )
    root = np.sqrt(weight * observations.share[o])
    whitening = observations.whitening[o]
    f00, f10, f11 = root * whitening[0], root * whitening[1], root * whitening[2]
    workspace.r[1] = f10 * workspace.r[0] + f11 * workspace.r[1]
    workspace.r[0] = f00 * workspace.r[0]
    for row in range(2):
        # weighted d r / d (U, V, W): du/d(U, V, W) = inverse ((1, 0, 0) - u/2 (U/L, V/L, W/L - 1))
        if row == 0:
            ru, rv = f00 * workspace.Ju[0, 0] * inverse, f00 * workspace.Ju[0, 1] * inverse
        else:
            ru = (f10 * workspace.Ju[0, 0] + f11 * workspace.Ju[1, 0]) * inverse
            rv = (f10 * workspace.Ju[0, 1] + f11 * workspace.Ju[1, 1]) * inverse
        along = (ru * u + rv * v) / (2.0 * L)
        rU, rV, rW = ru - along * U, rv - along * V, along * (L - W)
        for b in range(3):
            workspace.B[row, b] = rU * M[0, b] + rV * M[1, b] + rW * M[2, b]
            workspace.A[row, b] = -workspace.B[row, b]
        workspace.A[row, 3] = rV * W - rW * V
        workspace.A[row, 4] = rW * U - rU * W
        workspace.A[row, 5] = rU * V - rV * U
    for s in range(observations.interior[a]):
        workspace.A[0, 6 + s] = f00 * workspace.Jp[0, s]
        workspace.A[1, 6 + s] = f10 * workspace.Jp[0, s] + f11 * workspace.Jp[1, s]
    if observations.mounted[a]:
        _of_rig(a, observations.pose_of[i], state, workspace.A)
    seen: bool = L > W
    return seen


@inlined
def _of_rig(a: int, pose: int, state: State, A: FloatArray) -> None:
    """Convert derivatives by X0, w of a photograph to derivatives by its pose X_p, w_p and its mount X, w_a.

    X0 = X_p + R_p X and R = R_p R_a, so that dX0 = dX_p - R_p [X]x w_p + R_p dX and w = R_a' w_p + w_a.
    """
    R, M = state.rig_from_object[pose].T, state.camera_from_rig[a]
    X, Y, Z = state.mount_position[a, 0], state.mount_position[a, 1], state.mount_position[a, 2]
    for row in range(2):
        x, y, z = A[row, 0], A[row, 1], A[row, 2]
        b0 = x * R[0, 0] + y * R[1, 0] + z * R[2, 0]
        b1 = x * R[0, 1] + y * R[1, 1] + z * R[2, 1]
        b2 = x * R[0, 2] + y * R[1, 2] + z * R[2, 2]
        w0, w1, w2 = A[row, 3], A[row, 4], A[row, 5]
        mount = A[row, 6 + MAX_PARAMETERS :]
        mount[0], mount[1], mount[2], mount[3], mount[4], mount[5] = b0, b1, b2, w0, w1, w2
        A[row, 3] = w0 * M[0, 0] + w1 * M[1, 0] + w2 * M[2, 0] + Y * b2 - Z * b1
        A[row, 4] = w0 * M[0, 1] + w1 * M[1, 1] + w2 * M[2, 1] + Z * b0 - X * b2
        A[row, 5] = w0 * M[0, 2] + w1 * M[1, 2] + w2 * M[2, 2] + X * b1 - Y * b0


def sum_of_squares(observations: Observations, state: State, weight: FloatArray) -> float:
    """Return v'Pv of the image points; infinite if the camera of one with weight > 0 does not see it.

    Args:
        observations: image points.
        state: values of all parameters.
        weight: factor on the weight of each image point, (k,).
    """
    return float(_residuals(observations, state, weight, np.empty((0, 2))))


def residuals(observations: Observations, state: State) -> FloatArray:
    """Return v = computed - measured of all image points, px, (k, 2); NaN where the camera does not see it.

    Args:
        observations: image points.
        state: values of all parameters.
    """
    v = np.empty((len(observations.image), 2))
    _residuals(observations, state, np.ones(len(v)), v)
    return v


@compiled
def _residuals(observations: Observations, state: State, weight: FloatArray, v: FloatArray) -> float:
    """Return v'Pv and fill v with residuals unless it is empty; one kernel, as compiling takes seconds."""
    workspace = new_workspace()
    wanted = len(v) > 0
    total = 0.0
    for o in range(len(observations.image)):
        if weight[o] > 0.0:
            seen = _residual(o, observations, state, workspace)
            if wanted:
                v[o, 0] = workspace.r[0] if seen else np.nan
                v[o, 1] = workspace.r[1] if seen else np.nan
            elif not seen:
                return np.inf
            x = observations.whitening[o, 0] * workspace.r[0]
            y = observations.whitening[o, 1] * workspace.r[0] + observations.whitening[o, 2] * workspace.r[1]
            total += weight[o] * observations.share[o] * (x * x + y * y)
    return total


@inlined
def _residual(o: int, observations: Observations, state: State, workspace: Workspace) -> bool:
    """Fill the unweighted residual of image point o; False if its camera does not see it."""
    i, j = observations.image[o], observations.point[o]
    a = observations.camera[i]
    dX = state.points[j, 0] - state.position[i, 0]
    dY = state.points[j, 1] - state.position[i, 1]
    dZ = state.points[j, 2] - state.position[i, 2]
    U = state.M[i, 0, 0] * dX + state.M[i, 0, 1] * dY + state.M[i, 0, 2] * dZ
    V = state.M[i, 1, 0] * dX + state.M[i, 1, 1] * dY + state.M[i, 1, 2] * dZ
    W = state.M[i, 2, 0] * dX + state.M[i, 2, 1] * dY + state.M[i, 2, 2] * dZ
    L = 0.0
    if observations.frame[a, 6] > 0.0:
        L = np.sqrt(U * U + V * V + W * W)
        inverse = 2.0 / (L - W)
    else:
        inverse = -1.0 / W
    observe(
        observations.model[a],
        observations.frame[a],
        state.parameters[a],
        observations.xy[o, 0],
        observations.xy[o, 1],
        U * inverse,
        V * inverse,
        workspace.r,
        workspace.Ju,
        workspace.Jp,
    )
    seen: bool = W < L
    return seen  # a single exit: with an early return the compiler keeps the unused derivatives


def behind_camera(observations: Observations, state: State) -> BoolArray:
    """Return which image points belong to object points that the camera does not see or undetermined, (k,).

    Args:
        observations: image points.
        state: values of all parameters.
    """
    behind = np.empty(len(observations.image), dtype=np.bool_)
    _behind(observations, state, behind)
    return behind


@kernel
def _behind(observations: Observations, state: State, behind: BoolArray) -> None:
    for o in range(len(behind)):
        i, j = observations.image[o], observations.point[o]
        W, L2 = 0.0, 0.0
        for p in range(3):
            away = state.points[j, p] - state.position[i, p]
            W += state.M[i, 2, p] * away
            L2 += away * away
        reach = np.sqrt(L2) if observations.frame[observations.camera[i], 6] > 0.0 else 0.0
        behind[o] = not reach > W
