#!/usr/bin/env python3
"""Makes the robot models in assets/ from the asset files of robosuite, or compares assets/ with what it makes.

    pip download --no-deps --dest wheels robosuite==1.5.2
    pip install --target packages fast-simplification==0.2.0 numpy scipy trimesh==5.2.0
    PYTHONPATH=packages python3 sim/bake.py wheels/robosuite-1.5.2-py3-none-any.whl --check

Arm and gripper become one model. Visual meshes are merged by link and colour and reduced, collision meshes replaced by
reduced convex hulls; motors become velocity actuators with the robots' torque limits. Needs none of robosuite's code.
"""

import argparse
import filecmp
import pathlib
import sys
import tempfile
import xml.etree.ElementTree as ET
import zipfile

import fast_simplification
import numpy as np
import trimesh

ASSETS = pathlib.Path(__file__).parent / "assets"
SOURCE = "robosuite/models/assets"
ROBOTS = {
    "panda": {
        "gripper": "panda_gripper",
        "torques": [87, 87, 87, 87, 12, 12, 12],
        "fingers": {},
    },
    "sawyer": {
        "gripper": "rethink_gripper",
        "torques": [80, 80, 40, 40, 9, 9, 9],
        # robosuite commands each finger over the other's range.
        "fingers": {
            "r_finger_joint": "-0.020833 0.0115",
            "l_finger_joint": "-0.0115 0.020833",
        },
    },
}
VELOCITY_GAINS = [600, 600, 500, 400, 200, 150, 100]
VISUAL_TRIANGLES = 9000
LEAST_TRIANGLES = 60
HULL_TRIANGLES = 200
# The source's vertices are split along seams; those within this many metres become one, so that surfaces are connected.
WELD = 0.002


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("wheel", type=pathlib.Path, help="robosuite-1.5.2-py3-none-any.whl")
    parser.add_argument("--check", action="store_true", help="write nothing, compare")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        folder = pathlib.Path(folder)
        with zipfile.ZipFile(arguments.wheel) as wheel:
            wanted = [f"{SOURCE}/robots/{robot}/" for robot in ROBOTS] + [f"{SOURCE}/grippers/"]
            wheel.extractall(folder, [name for name in wheel.namelist() if name.startswith(tuple(wanted))])
        out = folder / "baked" if arguments.check else ASSETS
        for robot, settings in ROBOTS.items():
            bake(folder / SOURCE, robot, out, **settings)
        if arguments.check:
            sys.exit(differences(out, ASSETS))


def differences(made, kept):
    """Prints what differs and returns how many files do."""
    names = {str(path.relative_to(root)) for root in (made, kept) for path in root.rglob("*") if path.is_file()}
    same, different, missing = filecmp.cmpfiles(made, kept, sorted(names), shallow=False)
    for name in different + missing:
        print(f"{name}: {'differs' if name in different else 'is on one side only'}")
    print(f"{len(same)} files are the same, {len(different) + len(missing)} are not")
    return len(different) + len(missing)


def bake(source, robot, out, *, gripper, torques, fingers):
    """Writes OUT/ROBOT.xml and the meshes in OUT/ROBOT/."""
    arm = ET.parse(source / "robots" / robot / "robot.xml").getroot()
    hand = ET.parse(source / "grippers" / f"{gripper}.xml").getroot()
    base = arm.find("worldbody/body")
    next(body for body in base.iter("body") if body.get("name") == "right_hand").extend(hand.findall("worldbody/body"))
    meshes = Meshes([(arm, source / "robots" / robot), (hand, source / "grippers")], out / robot)
    simplify(base, meshes)
    meshes.write_visuals({body.get("name"): body for body in base.iter("body")})

    model = ET.Element("mujoco", model=robot)
    ET.SubElement(model, "compiler", angle="radian")
    defaults = ET.SubElement(model, "default")
    visual = {"contype": "0", "conaffinity": "0", "group": "1", "mass": "0"}
    collision = {"contype": "4", "conaffinity": "0", "group": "3", "friction": "0.4 0.005 0.0001"}
    for name, geom in [("agentvis", visual), ("agentcol", collision)]:
        ET.SubElement(ET.SubElement(defaults, "default", {"class": name}), "geom", geom)
    assets = ET.SubElement(model, "asset")
    for name in meshes.written:
        inertia = "convex" if name.startswith("col_") else "shell"
        ET.SubElement(assets, "mesh", name=name, file=f"{name}.stl", inertia=inertia)
    for body in base.iter("body"):
        body.set("gravcomp", "1")
    ET.SubElement(model, "worldbody").append(base)

    actuators = ET.SubElement(model, "actuator")
    is_finger = lambda joint: "finger" in joint.get("name")
    for joint in base.iter("joint"):
        joint.set("armature", "0.2" if is_finger(joint) else "0.1")
        joint.set("damping", "20" if is_finger(joint) else "1")
    joints = [joint.get("name") for joint in base.iter("joint") if not is_finger(joint)]
    for joint, gain, torque in zip(joints, VELOCITY_GAINS, torques, strict=True):
        limits = {"forcelimited": "true", "forcerange": f"{-torque} {torque}"}
        ET.SubElement(actuators, "velocity", name=f"vel_{joint}", joint=joint, kv=str(gain), **limits)
    for finger in hand.iter("position"):
        finger.set("kp", "400")
        if finger.get("joint") in fingers:
            finger.set("ctrlrange", fingers[finger.get("joint")])
        actuators.append(finger)
    ET.indent(model)
    ET.ElementTree(model).write(out / f"{robot}.xml")


def simplify(body, meshes):
    """Takes visual geoms out, replaces collision meshes, and drops what the scenes do not use, in a body and below."""
    for child in list(body):
        unused_site = child.tag == "site" and child.get("name") != "grip_site"
        weightless = child.tag == "inertial" and float(child.get("mass")) < 1e-5
        if child.tag == "camera" or unused_site or weightless:
            body.remove(child)
    for site in body.findall("site"):
        site.set("rgba", "0 0 0 0")
        site.set("group", "4")
    for geom in body.findall("geom"):
        if geom.get("group") == "1" or geom.get("class") == "visual":
            body.remove(geom)
            meshes.add_visual(body.get("name"), geom)
            continue
        geom.set("class", "agentcol")
        for attribute in ("contype", "conaffinity", "solref", "friction", "condim", "group"):
            geom.attrib.pop(attribute, None)
        if geom.get("type") == "mesh":
            geom.set("mesh", meshes.write_hull(geom.get("mesh")))
    for child in body.findall("body"):
        simplify(child, meshes)


class Meshes:
    """The meshes of a robot: found by name in the models' assets, written to one folder."""

    def __init__(self, models, folder):
        self.folder = folder
        self.folder.mkdir(parents=True, exist_ok=True)
        self.written = []
        self._files, self._colours, self._groups = {}, {}, {}
        for model, where in models:
            for mesh in model.iter("mesh"):
                self._files[mesh.get("name")] = (where / mesh.get("file"), numbers(mesh.get("scale", "1 1 1")))
            for material in model.iter("material"):
                self._colours[material.get("name")] = numbers(material.get("rgba", "1 1 1 1"))

    def add_visual(self, body, geom):
        mesh = self._load(geom.get("mesh"))
        mesh.apply_transform(transform(numbers(geom.get("quat", "1 0 0 0")), numbers(geom.get("pos", "0 0 0"))))
        own = geom.get("rgba")
        colour = numbers(own) if own else self._colours.get(geom.get("material"), [1, 1, 1, 1])
        # Colours that are nearly the same are one.
        key = tuple(np.round(np.array(colour[:3]) * 6) / 6)
        self._groups.setdefault((body, key), []).append((mesh, colour))

    def write_visuals(self, bodies):
        """One mesh for each link and colour, with a share of the triangles like its share of the source's."""
        whole = sum(len(mesh.faces) for parts in self._groups.values() for mesh, _ in parts)
        for number, ((body, _), parts) in enumerate(self._groups.items()):
            merged = trimesh.util.concatenate([mesh for mesh, _ in parts])
            areas = [mesh.area for mesh, _ in parts]
            colour = np.average([colour for _, colour in parts], axis=0, weights=areas)
            share = int(VISUAL_TRIANGLES * len(merged.faces) / whole)
            name = self._write(f"v{number}_{body}", reduced(merged, max(LEAST_TRIANGLES, share)))
            rgba = " ".join(f"{value:.3f}" for value in colour)
            ET.SubElement(bodies[body], "geom", {"class": "agentvis", "type": "mesh", "mesh": name, "rgba": rgba})

    def write_hull(self, name):
        """The name of the reduced convex hull of a mesh."""
        return self._write(f"col_{name}", reduced(self._load(name).convex_hull, HULL_TRIANGLES))

    def _load(self, name):
        file, scale = self._files[name]
        mesh = trimesh.load(file, force="mesh", process=True)
        if scale != [1, 1, 1]:
            mesh.apply_scale(scale)
        return mesh

    def _write(self, name, mesh):
        mesh.export(self.folder / f"{name}.stl")
        if name not in self.written:
            self.written.append(name)
        return name


def reduced(mesh, triangles):
    """The mesh with about so many triangles or fewer."""
    grid = np.round(mesh.vertices / WELD).astype(np.int64)
    _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    faces = place.reshape(-1)[mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (a != c)]
    _, once = np.unique(np.sort(faces, 1), axis=0, return_index=True)
    faces, vertices = faces[np.sort(once)], mesh.vertices[first]
    if len(faces) < 4:
        return mesh
    if len(faces) > triangles:
        vertices, faces = fast_simplification.simplify(
            vertices.astype(np.float32), faces.astype(np.int32), target_count=triangles, agg=5
        )
    return trimesh.Trimesh(vertices, faces, process=False)


def transform(quaternion, position):
    w, x, y, z = np.array(quaternion) / np.linalg.norm(quaternion)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, 3] = position
    return matrix


def numbers(text):
    return [float(word) for word in text.split()]


if __name__ == "__main__":
    main()
