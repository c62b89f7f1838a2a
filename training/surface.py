"""The surface of a body at rest, functions on its triangles for clothes and textures, and surfaces stitched from rings.

Rule: arrays are float64 and int64, so that no result is rounded to float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from trilane.arrays import F64, Ints
from trilane.body.body import ShapedBody
from trilane.body.joints import JOINT_INDEX, JOINTS


@dataclass(frozen=True)
class BodyArrays:
    """Arrays of a body at rest.

    `vertices`: (V,3), in metres. `faces`: (F,3) indices of vertices.
    `uv`: texture coordinates (T,2). `uv_faces`: (F,3) indices of `uv`.
    `weights`: skinning weights (V,55). `joints`: (55,3), in metres.
    """

    vertices: F64
    faces: NDArray[np.int64]
    uv: F64
    uv_faces: NDArray[np.int64]
    weights: F64
    joints: F64


def body_arrays(shaped: ShapedBody) -> BodyArrays:
    """Return the arrays of `shaped`, as float64 and int64."""
    body = shaped.body
    return BodyArrays(
        vertices=shaped.vertices.astype(np.float64),
        faces=body.faces.astype(np.int64),
        uv=body.uv.astype(np.float64),
        uv_faces=body.uv_faces.astype(np.int64),
        weights=body.weights.astype(np.float64),
        joints=shaped.joints,
    )


# Geometry of triangle surfaces: normals, areas, smoothing, shells that stand off, and ambient light behind occluders.
#
# Rule: functions take and return arrays; they know nothing of bodies and garments.


def vertex_normals(vertices: F64, faces: Ints) -> F64:
    """Return the unit normal (V,3) of each vertex: the mean of its faces' normals, weighted by area.

    A vertex without a face gets +Y.

    `vertices`: (V,3). `faces`: (F,3) indices of vertices.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normal = np.cross(b - a, c - a)
    total = np.stack([_scatter(faces, np.repeat(face_normal[:, k], 3), len(vertices)) for k in range(3)], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 1e-12, total / np.maximum(length, 1e-12), [0.0, 1.0, 0.0])


def vertex_areas(vertices: F64, faces: Ints) -> F64:
    """Return the area (V,) of each vertex, in square metres: a third of the total area of the vertex's faces.

    `vertices`: (V,3), in metres. `faces`: (F,3) indices of vertices.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 6.0
    return _scatter(faces, np.repeat(area, 3), len(vertices))


class Smoother:
    """Smooths values at the vertices of a mesh by means over neighbours. A vertex without a face keeps its value.

    `faces`: (F,3). `count`: number V of vertices.
    """

    def __init__(self, faces: Ints, count: int) -> None:
        edges = np.unique(np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
        self._from = np.concatenate([edges[:, 0], edges[:, 1]])
        self._to = np.concatenate([edges[:, 1], edges[:, 0]])
        self._degree = np.bincount(self._to, minlength=count)
        self._count = count

    def mean(self, values: F64) -> F64:
        """Return, for each vertex, the mean of its neighbours' values. `values` and the result: (V,) or (V,C)."""
        columns = values.reshape(self._count, -1)
        sums = [np.bincount(self._to, weights=column[self._from], minlength=self._count) for column in columns.T]
        around = np.stack(sums, axis=1) / np.maximum(self._degree, 1)[:, None]
        return np.where(self._degree[:, None] > 0, around, columns).reshape(values.shape)

    def smooth(self, values: F64, rounds: int) -> F64:
        """Return `values` (V,) or (V,C) after `rounds` rounds; each moves them half way to the neighbours' means."""
        for _ in range(rounds):
            values = 0.5 * (values + self.mean(values))
        return values


def shell(vertices: F64, faces: Ints, offset: F64, least: F64, rounds: int) -> F64:
    """Return the vertices (V,3) of a smooth surface over a mesh, which bridges hollows as cloth does.

    The mesh is raised along smoothed normals. After that, each round smooths the surface. If vertices sink below their
    least height, the round raises them to it along the normals.

    `vertices` (V,3), `faces` (F,3): the mesh.
    `offset`: height (V,), in metres, to which the mesh is raised first.
    `least`: least height (V,) over the mesh, in metres.
    `rounds`: number of rounds of smoothing.
    """
    smoother = Smoother(faces, len(vertices))
    normal = smoother.smooth(vertex_normals(vertices, faces), 6)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    raised = vertices + offset[:, None] * normal
    for _ in range(rounds):
        raised = 0.5 * (raised + smoother.mean(raised))
        height = np.einsum("ij,ij->i", raised - vertices, normal)
        raised = raised + np.maximum(least - height, 0.0)[:, None] * normal
    return raised


def obscurance(points: F64, normals: F64, emitters: F64, emitter_normals: F64, areas: F64, reach: float) -> F64:
    """Return the share (N,) of ambient light, in 0..1, that reaches points although discs occlude it.

    The share is computed from disc-to-point form factors: M. Bunnell, Dynamic Ambient Occlusion and Indirect Lighting,
    GPU Gems 2, 2005.

    `points`, `normals`: points (N,3) at which the light is computed, and normals (N,3) there.
    `emitters`, `emitter_normals`: centres (M,3) and normals (M,3) of the discs.
    `areas`: areas (M,) of the discs, square metres.
    `reach`: distance in metres at which a disc's effect has faded out.
    """
    left = np.empty(len(points))
    for part in np.array_split(np.argsort(points[:, 1]), max(1, len(points) // 256)):
        low, high = points[part].min(axis=0) - reach, points[part].max(axis=0) + reach
        near = ((emitters >= low) & (emitters <= high)).all(axis=1)
        away = emitters[near][None] - points[part, None]
        square = np.einsum("ijk,ijk->ij", away, away) + 1e-6
        distance = np.sqrt(square)
        at_point = np.einsum("ijk,ik->ij", away, normals[part]) / distance
        at_emitter = -np.einsum("ijk,jk->ij", away, emitter_normals[near]) / distance
        area = areas[near]
        factor = np.clip(at_point, 0.0, 1.0) * np.clip(at_emitter, 0.0, 1.0) * area / (np.pi * square + area)
        fade = np.clip(1.0 - distance / reach, 0.0, 1.0)
        left[part] = 1.0 - np.minimum((factor * fade).sum(axis=1), 1.0)
    return left


def smoothstep(low: float, high: float, values: F64) -> F64:
    """Return GLSL's smoothstep of `values`: 0 at `low`, 1 at `high`, a cubic between. `low` may be above `high`."""
    t = np.clip((values - low) / (high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def _scatter(faces: Ints, values: F64, count: int) -> F64:
    return np.asarray(np.bincount(faces.ravel(), weights=values, minlength=count), np.float64)


# Surfaces that are stitched from rings and not raised from the body's mesh: shoes, a skirt, hair that falls.
#
# Rule: a ring is the widened outline of vertices of the body, as seen from above. It lies at one height, and encloses
# vertices at that height or above. No coordinate is a constant. Faces join each ring to the next.

Stitched = tuple[F64, NDArray[np.int64]]

# A shoe: a stack of horizontal slices of the foot, each convex and a little wider than the foot.
#
# Rule: a slice comes from the support function of the foot's vertices as seen from above. The shoe is closed below and
# open at the ankle.

ANGLES = 48
MARGIN_M = 0.009
TOP_M = 0.035  # height of the shoe above the ankle joint
SOLE_M = 0.010  # thickness of the sole under the foot
WELT_M = 0.016  # height of the sole's edge above the underside of the foot
UPPER_STEP_M, FLANGE_M = 0.004, 0.005


def shoe(vertices: F64, ankle: F64, side: int, sole: bool) -> Stitched:
    """Return vertices (N,3), metres, and faces (F,3) of one shoe's upper or of its sole.

    `vertices`: body at rest, (V,3).
    `ankle`: place of the foot's joint, (3,).
    `side`: 1 for the left foot, -1 for the right one.
    `sole`: whether to return the sole instead of the upper.
    """
    foot = vertices[(vertices[:, 0] * side > 0) & (vertices[:, 1] < ankle[1] + TOP_M + 0.02)]
    ground = foot[:, 1].min()
    if sole:
        heights = np.array([ground - SOLE_M, ground - SOLE_M + 0.002, ground, ground + WELT_M - 0.002, ground + WELT_M])
        margins = MARGIN_M + np.array([0.0, FLANGE_M, FLANGE_M, FLANGE_M, 0.0])
    else:
        heights = np.arange(ground + WELT_M - 0.004, ankle[1] + TOP_M, UPPER_STEP_M)
        margins = np.full(len(heights), MARGIN_M)
    rings = [
        _ring(foot[foot[:, 1] >= min(height - 0.008, ankle[1])], height, margin)
        for height, margin in zip(heights, margins, strict=True)
    ]
    points = np.vstack([*rings, rings[0].mean(axis=0, keepdims=True), rings[-1].mean(axis=0, keepdims=True)])
    return points, _stitch(len(rings), sole)


def _ring(foot: F64, height: float, margin: float) -> F64:
    """Return the smoothed outline (ANGLES,3) of the points `foot` (N,3) as seen from above, metres.

    The outline is widened by `margin` and lies at `height`.
    """
    flat = foot[:, [2, 0]]
    centre = 0.5 * (flat.min(axis=0) + flat.max(axis=0))
    angle = np.arange(ANGLES) * (2 * np.pi / ANGLES)
    towards = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    support = ((flat - centre) @ towards.T).max(axis=0) + margin
    facing = np.cos(angle[:, None] - angle[None])
    radius = np.where(facing > 0.05, support[None] / np.maximum(facing, 0.05), np.inf).min(axis=1)
    radius = 0.25 * np.roll(radius, 1) + 0.5 * radius + 0.25 * np.roll(radius, -1)
    flat = centre + radius[:, None] * towards
    return np.stack([flat[:, 1], np.full(ANGLES, height), flat[:, 0]], axis=1)


def _stitch(rings: int, capped: bool) -> NDArray[np.int64]:
    """Return the faces (F,3) between consecutive rings, and a fan that closes the first ring.

    Two vertices follow the rings: the centres of the first and the last ring.

    `capped`: whether a fan closes the last ring too.
    """
    here = np.arange(ANGLES)
    after = (here + 1) % ANGLES
    faces = [_walls(rings)]
    bottom = np.full(ANGLES, rings * ANGLES)
    faces.append(np.stack([bottom, after, here], 1))
    if capped:
        last = (rings - 1) * ANGLES
        faces.append(np.stack([bottom + 1, last + here, last + after], 1))
    return np.vstack(faces)


def _walls(rings: int) -> NDArray[np.int64]:
    """Return the faces (F,3) between consecutive rings of ANGLES vertices; they face outwards if rings ascend."""
    here = np.arange(ANGLES)
    after = (here + 1) % ANGLES
    faces = []
    for ring in range(rings - 1):
        low, high = ring * ANGLES, (ring + 1) * ANGLES
        faces += [
            np.stack([low + here, low + after, high + here], 1),
            np.stack([low + after, high + after, high + here], 1),
        ]
    return np.vstack(faces)


# A skirt: rings around both legs and the hips, from the hem up to the waist. It is open at the hem and at the waist.
#
# Rule: cloth falls, so a ring also encloses everything above it. Above the hips the skirt follows the trunk. Below the
# hips, each side follows its thigh, and the middle follows both thighs.

WAIST_M, HEM_M = 0.105, 0.02  # heights of waist and hem above the pelvis and the knee
SKIRT_STEP_M = 0.016
PLEATS, PLEAT_M = 8, 0.012
#: Distance from the body's middle at which the skirt follows one thigh alone, in distances of the hip joint.
PARTED = 1.05


def skirt(vertices: F64, joints: F64) -> Stitched:
    """Return vertices (N,3), metres, and faces (F,3) of a skirt from the waist to the knees.

    `vertices`, `joints`: body at rest, (V,3) and (55,3).
    """
    pelvis, knee, shoulder = (joints[JOINT_INDEX[name]] for name in ("pelvis", "left_knee", "left_shoulder"))
    top, hem = pelvis[1] + WAIST_M, knee[1] + HEM_M
    body = vertices[(np.abs(vertices[:, 0]) < shoulder[0] + 0.1) & (vertices[:, 1] < top + 0.012)]
    heights = np.linspace(hem, top, round((top - hem) / SKIRT_STEP_M) + 1)
    angle = np.arange(ANGLES) * (2 * np.pi / ANGLES)
    rings = []
    for height in heights:
        fallen = float(smoothstep(pelvis[1] + 0.02, hem, np.array(height)))
        ring = _ring(body[body[:, 1] > height - 0.012], height, 0.020 + 0.030 * fallen)
        away = ring - ring.mean(axis=0)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        rings.append(ring + (PLEAT_M * fallen * np.sin(PLEATS * angle))[:, None] * away)
    return np.vstack(rings), _walls(len(rings))


def skirt_weights(points: F64, trunk: F64, joints: F64) -> F64:
    """Return the skinning weights (N,55) of the `points` (N,3) of a skirt.

    `trunk`: weights (N,55) of the body under the points. `joints`: body at rest, (55,3).
    """
    hip = joints[JOINT_INDEX["left_hip"]]
    left = smoothstep(-PARTED * hip[0], PARTED * hip[0], points[:, 0])
    thigh = smoothstep(hip[1] + 0.05, hip[1] - 0.14, points[:, 1])
    legs = np.zeros((len(points), JOINTS))
    legs[:, JOINT_INDEX["left_hip"]], legs[:, JOINT_INDEX["right_hip"]] = left, 1 - left
    return trunk * (1 - thigh)[:, None] + legs * thigh[:, None]


# Long hair: rings around a sheet that begins in the hair of the head and falls behind the neck to the shoulder blades.
#
# Rule: half of a ring is the outside of the sheet, from ear to ear around the back; the other half is its inside. The
# sheet is closed, since outside and inside meet at its sides and its ends.

FALL_M = 0.20  # how far below the joint of the neck long hair ends
RISE_M = 0.075  # how far above the eyes its sheet begins
LOCKS_STEP_M = 0.014
SHEET_M = 0.020
LOCK_M = 0.003


def long_hair(vertices: F64, joints: F64, eye: F64) -> Stitched:
    """Return vertices (N,3), metres, and faces (F,3) of hair that falls from the head over the back.

    `vertices`, `joints`: body at rest, (V,3) and (55,3). `eye`: centre (3,) of an eyeball.
    """
    neck = joints[JOINT_INDEX["neck"]]
    top, end = eye[1] + RISE_M, neck[1] - FALL_M
    middle = np.abs(vertices[:, 0]) < 0.65 * joints[JOINT_INDEX["left_shoulder"], 0]
    head = vertices[(vertices[:, 1] > neck[1] + 0.06) & middle]
    back = vertices[middle & (vertices[:, 2] < neck[2] - 0.03)]
    heights = np.linspace(end, top, round((top - end) / LOCKS_STEP_M) + 1)
    low, rise = smoothstep(eye[1] - 0.06, end, heights)[:, None], smoothstep(top, top - 0.10, heights)[:, None]
    ends = smoothstep(end, end + 0.05, heights)[:, None] * rise
    across = np.linspace(-1, 1, ANGLES // 2)
    at = np.pi + across * np.radians(110 - 54 * low)
    radius = np.empty_like(at)
    centre = joints[JOINT_INDEX["head"]] * (0, 0, 1)
    for row, height in enumerate(heights):
        near = back[np.abs(back[:, 1] - height - 0.01) < 0.03]
        around = _ring(np.vstack([head[head[:, 1] > height - 0.012], near]), height, 0.018) - centre
        turn = np.arctan2(around[:, 0], around[:, 2])
        radius[row] = np.interp(at[row], turn, np.hypot(around[:, 0], around[:, 2]), period=2 * np.pi)
    from scipy.ndimage import gaussian_filter1d  # here, as in clothing.py

    # The sides and the top of the sheet dive into the hair of the head.
    radius = gaussian_filter1d(radius, 2.0, axis=0) + 0.034 * rise - 0.018 - 0.022 * across**6 * (1 - low)
    radius += 0.034 * smoothstep(eye[1] - 0.06, neck[1] - 0.04, heights)[:, None]
    radius += LOCK_M * np.sin(26 * at + 3 * np.sin(9 * heights[:, None])) * ends
    thick = SHEET_M * ends * np.sqrt(1 - across**2)
    height = heights[:, None] - 0.035 * (1 - across**2) * low**3
    outside, inside = (
        centre + np.stack([distance * np.sin(at), height, distance * np.cos(at)], axis=2)
        for distance in (radius, radius - thick)
    )
    return np.concatenate([outside, inside[:, ::-1]], axis=1).reshape(-1, 3), _walls(len(heights))


def long_hair_weights(points: F64, joints: F64) -> F64:
    """Return the skinning weights (N,55) of the `points` (N,3) of long hair, for the joints head, neck and spine3.

    `joints`: body at rest, (55,3).
    """
    head, neck = (joints[JOINT_INDEX[name], 1] for name in ("head", "neck"))
    weights = np.zeros((len(points), JOINTS))
    weights[:, JOINT_INDEX["head"]] = on_head = smoothstep(neck - 0.01, head + 0.02, points[:, 1])
    weights[:, JOINT_INDEX["spine3"]] = on_back = smoothstep(neck + 0.06, neck - 0.06, points[:, 1]) * (1 - on_head)
    weights[:, JOINT_INDEX["neck"]] = 1 - on_head - on_back
    return weights
