"""The kitchen as C MuJoCo steps it, and a light scene of the same robot, kettle and stove for MJX.

Both are read from the installed gymnasium-robotics package and edited in memory.
"""

import importlib.util
from pathlib import Path

import mujoco
import numpy as np

from represent_jax.errors import RepresentError

# What does not stand in the light scene; what is below these bodies goes with them.
_FIXTURES = (
    "counters1",
    "backwall",
    "slidecabinet",
    "hingecabinet",
    "microwave",
    "hoodroot",
    *(f"knob {i}" for i in range(1, 5)),
    *(f"Burner {i}" for i in range(1, 5)),
)
# Of the six radii of capsules along a finger the light scene keeps three, one capsule of each.
_FINGER_RADII = (0.0070, 0.0082, 0.0100)
_HAND = "panda0_link7"
_MOVING = (
    *(f"panda0_link{i}" for i in range(8)),
    "panda0_leftfinger",
    "panda0_rightfinger",
    "kettle",
    "kettleroot",
)
# The hull of the hand's mesh, as a capsule across the palm in the frame of the last link.
_PALM = {
    "size": [0.04, 0.06, 0.0],
    "pos": [0.0, 0.0, 0.137],
    "quat": [0.653, 0.653, -0.271, -0.271],
}

_BOX, _CAPSULE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
_CYLINDER, _PLANE = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_PLANE
# Which sizes of a geom make it thicker.
_GROWS = {_BOX: (1.0, 1.0, 1.0), _CAPSULE: (1.0, 0.0, 0.0), _PLANE: (0.0, 0.0, 0.0)}


def load_full() -> mujoco.MjModel:
    """Compiles the whole kitchen of FrankaKitchen-v1; only the free camera is set.

    Raises:
      RepresentError: gymnasium-robotics is not installed.
    """
    return _read().compile()


def load_light() -> mujoco.MjModel:
    """Compiles arm, fingers, kettle, stove and floor, of which capsules and boxes collide.

    Bodies keep the masses and inertias of the full scene. Positions are those of the arm (9) and
    of the kettle (7); nothing else moves, and contacts have no torsional or rolling friction.

    On CPU hosts MJX needs `XLA_FLAGS=--xla_cpu_use_fusion_emitters=false`, or the same among the
    `compiler_options` of the outermost jit: fused, the arm's chain of eleven bodies is computed
    anew for every body behind, and a step takes minutes.

    Raises:
      RepresentError: gymnasium-robotics is not installed.
    """
    spec = _read()
    full = spec.compile()
    for element in (*spec.equalities, *spec.keys, *spec.lights):
        spec.delete(element)
    for name in _FIXTURES:
        spec.delete(spec.body(name))
    for body in spec.bodies:
        if body.name in _MOVING:
            _keep_inertia(body, full)
        kept = _light_geoms(body)
        for geom in body.geoms:
            if not any(geom is one for one in kept):
                spec.delete(geom)
    spec.body(_HAND).add_geom(type=_CAPSULE, contype=1, conaffinity=1, group=3, **_PALM)
    for geom in spec.geoms:
        geom.condim = 3
        geom.material = ""
        if geom.type == _CYLINDER:
            geom.type = _CAPSULE
        # MJX's boxes do not feel each other before they touch, so margins become thickness.
        geom.size = geom.size + np.array(_GROWS[geom.type]) * geom.margin
        geom.margin = 0.0
    for element in (*spec.meshes, *spec.textures, *spec.materials):
        spec.delete(element)
    return spec.compile()


def _read() -> mujoco.MjSpec:
    found = importlib.util.find_spec("gymnasium_robotics")
    if found is None:
        raise RepresentError(
            "the kitchen needs an extra package: pip install 'represent_jax[kitchen]'"
        )
    assets = Path(found.submodule_search_locations[0]) / "envs" / "assets" / "kitchen_franka"
    spec = mujoco.MjSpec.from_file(str(assets / "kitchen_assets" / "kitchen_env_model.xml"))
    # The free camera of FrankaKitchen-v1; videos have no other.
    spec.stat.center, spec.stat.extent = np.array([-0.2, 0.5, 2.0]), 1.5
    view = getattr(spec.visual, "global")
    view.azimuth, view.elevation = 70.0, -35.0
    return spec


def _keep_inertia(body: mujoco.MjsBody, full: mujoco.MjModel) -> None:
    """Gives a body the inertia it has in the full scene, whatever geoms it loses."""
    i = full.body(body.name).id
    body.explicitinertial = True
    body.mass, body.inertia = full.body_mass[i], full.body_inertia[i]
    body.ipos, body.iquat = full.body_ipos[i], full.body_iquat[i]


def _light_geoms(body: mujoco.MjsBody) -> list[mujoco.MjsGeom]:
    """What of a body collides in the light scene."""
    if body.name.endswith("finger"):
        # Capsules come in pairs of one radius that cross at 3 mm; the first of each pair will do.
        by_radius = {float(g.size[0]): g for g in reversed(body.geoms) if g.type == _CAPSULE}
        return [by_radius[radius] for radius in _FINGER_RADII]
    colliding = [geom for geom in body.geoms if geom.contype or geom.conaffinity]
    if body.name == "ovenroot":
        return [geom for geom in colliding if geom.type == _BOX]
    if body.name == "kettleroot":
        return colliding
    return [geom for geom in colliding if geom.type == _PLANE]
