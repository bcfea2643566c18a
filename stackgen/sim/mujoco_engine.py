"""MuJoCo as an engine of the simulator: soft contacts, made as stiff as their step allows.

A model holds the blocks of one block list; it is compiled once (2 ms) and kept, since most stacks that
are asked about in a row have the same blocks. Each rollout starts from data that were reset, so it depends
on the stack alone. docs/physics.md says how MuJoCo's verdicts differ from Bullet's.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from stackgen.errors import StackgenError
from stackgen.sim.physics import MUJOCO_NUMBERS, Physics, unit_inertia
from stackgen.world import Shape

Floats = NDArray[np.float64]

# MuJoCo prints its warnings and writes them into a file of the working folder; `step` reads and says them instead.
mujoco.set_mju_user_warning(lambda text: None)

_MODELS_KEPT = 64
_SCALAR_FIRST = [0, 1, 2, 6, 3, 4, 5]
"""Place of each of MuJoCo's coordinates (position, then w, x, y, z) among ours (position, then x, y, z, w)."""
_SCALAR_LAST = [0, 1, 2, 4, 5, 6, 3]
_MEMORY_PER_BLOCK = 1 << 20
"""Room for the contacts of one block [byte]; blocks that lie inside each other need most."""


class MujocoEngine:
    """Models of MuJoCo, kept for many stacks.

    Args:
        physics: Numbers of the physics.
    """

    def __init__(self, physics: Physics) -> None:
        self.physics = physics
        self.kept: OrderedDict[tuple[Shape, ...], tuple[mujoco.MjModel, mujoco.MjData]] = OrderedDict()

    def put(self, shapes: Sequence[Shape], positions: Floats, quaternions: Floats) -> None:
        """Put blocks on an empty ground."""
        key = tuple(shapes)
        if key not in self.kept:
            model = compiled(key, self.physics)
            self.kept[key] = model, mujoco.MjData(model)
            if len(self.kept) > _MODELS_KEPT:
                self.kept.popitem(last=False)
        self.kept.move_to_end(key)
        self.model, self.data = self.kept[key]
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = np.concatenate([positions, quaternions], axis=1)[:, _SCALAR_FIRST].ravel()

    def step(self, number: int, forces: Floats | None = None) -> None:
        """Let a number of steps pass, under forces (k, 3) [N] on the centres of mass.

        Raises:
            StackgenError: If MuJoCo gave up: it lacked room for contacts, or a motion grew without bound.
        """
        if forces is not None:
            self.data.xfrc_applied[1:, :3] = forces
        mujoco.mj_step(self.model, self.data, number)
        if self.data.warning.number.any():
            raise StackgenError(
                f"MuJoCo cannot simulate this stack of {self.model.nbody - 1} blocks: too many of them lie inside each"
                " other; move them apart, or ask `--physics.engine bullet`"
            )

    def states(self) -> Floats:
        """Read centres of mass [m] and quaternions, (k, 7)."""
        return self.data.qpos.reshape(-1, 7)[:, _SCALAR_LAST]

    def close(self) -> None:
        """Give MuJoCo's memory back."""
        self.kept.clear()


def compiled(shapes: Sequence[Shape], physics: Physics) -> mujoco.MjModel:
    """Compile a model of a ground and blocks, whose frames are at their centres of mass."""
    spec = mujoco.MjSpec()
    spec.memory = (len(shapes) + 1) * _MEMORY_PER_BLOCK
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    spec.option.timestep = MUJOCO_NUMBERS["time_step"]
    spec.option.gravity = [0, 0, -physics.gravity]
    # Explicit integration breaks down where blocks that lay inside each other are thrown apart, spinning.
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    solref, solimp = (list(map(float, MUJOCO_NUMBERS[name].split())) for name in ("solref", "solimp"))
    surface = {
        "friction": [physics.friction, 0, 0],  # of two surfaces MuJoCo takes the larger coefficient
        "condim": 3,
        "solref": solref,
        "solimp": [*solimp, 0.5, 2],
    }
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], **surface)
    meshes: dict[Shape, str] = {}
    for shape in shapes:
        mass = physics.density * shape.volume * physics.cell_size**3
        body = spec.worldbody.add_body(
            mass=mass, inertia=mass * physics.cell_size**2 * unit_inertia(shape), explicitinertial=True
        )
        body.add_freejoint()
        if shape.is_box:
            half = np.array(shape.size) / 2 * physics.cell_size
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **surface)
            continue
        if shape not in meshes:
            meshes[shape] = f"mesh {len(meshes)}"
            corners = (shape.vertices - shape.center_of_mass) * physics.cell_size
            spec.add_mesh(name=meshes[shape], uservert=corners.ravel())
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=meshes[shape], **surface)
    return spec.compile()
