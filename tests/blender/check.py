r"""Opens one level set in headless Blender (the PyPI package bpy) and compares what Blender sees with what is expected.

Blender reads the file with its own copy of OpenVDB and makes its own mesh of the zero set, so that agreement says that
the file is what other programs take it for. Every expectation is an argument; lengths are in world units:

    check.py FILE.vdb --grid surface --voxel-size 0.01 --bbox=-1,-1,-1,1,1,1 --vertices 183000,194000 \
        --area 12.57 --volume 4.19 [--png FILE.png]

Prints one line a check and ends with status 1 if any failed. Needs CPython 3.11 with bpy 5.0.1.
"""

import argparse
import math
import os
import sys

import bpy
import numpy as np
from mathutils import Matrix, Vector

class Checks:
    """Counts what agrees and what does not, one printed line each."""

    def __init__(self):
        self.passed = 0
        self.failed = 0

    def that(self, ok, what, seen, expected):
        if ok:
            self.passed += 1
        else:
            self.failed += 1
        print(f"{'ok    ' if ok else 'FAILED'} {what}: {seen} (expected {expected})")

    def near(self, what, seen, expected, tolerance):
        self.that(abs(seen - expected) <= tolerance, what, f"{seen:.7g}", f"{expected:.7g} ± {tolerance:.2g}")


def numbers(count):
    """An argument type: `count` comma-separated numbers."""

    def parse(text):
        values = [float(part) for part in text.split(",")]
        if len(values) != count:
            raise argparse.ArgumentTypeError(f"{len(values)} numbers in '{text}', {count} are needed")
        return np.array(values)

    return parse


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("file")
    parser.add_argument("--grid", required=True, help="name of the only grid")
    parser.add_argument("--voxel-size", type=float, required=True)
    parser.add_argument("--half-width", type=float, help="voxels; the background must be that far away")
    parser.add_argument("--bbox", type=numbers(6), required=True, help="of the surface: x0,y0,z0,x1,y1,z1")
    parser.add_argument("--vertices", type=numbers(2), required=True, help="of the mesh: least,most")
    parser.add_argument("--area", type=float, required=True)
    parser.add_argument("--volume", type=float, required=True)
    parser.add_argument("--bbox-tolerance", type=float, default=1.0, help="voxels")
    parser.add_argument("--tolerance", type=float, default=0.015, help="relative, of area and volume")
    parser.add_argument("--png", help="also renders a picture")
    return parser.parse_args()


def load(path):
    """The volume object in an otherwise empty scene, and its grids (read lazily: nothing is there before load())."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    volume = bpy.data.volumes.new("volume")
    volume.filepath = os.path.abspath(path)
    if not volume.grids.load():
        raise SystemExit(f"FAILED Blender cannot load {path}: {volume.grids.error_message}")
    holder = bpy.data.objects.new("volume", volume)
    bpy.context.scene.collection.objects.link(holder)
    return holder, list(volume.grids)


def openvdb_grid(path, name):
    """The grid as Blender's copy of the OpenVDB module reads it: bpy itself does not tell class and background."""
    version_folder = os.path.dirname(bpy.utils.system_resource("SCRIPTS"))
    modules = os.path.join(version_folder, "python", "lib", "python3.11", "site-packages")
    if modules not in sys.path:
        sys.path.append(modules)
    import openvdb

    return openvdb.read(os.path.abspath(path), name)


def evaluated_mesh(holder):
    """The mesh that the modifiers of an object make."""
    graph = bpy.context.evaluated_depsgraph_get()
    return bpy.data.meshes.new_from_object(holder.evaluated_get(graph), depsgraph=graph)


def mesh_by_modifier(volume_object, grid_name):
    """Volume to Mesh. Its threshold is 0.1 by default, which is a density: a level set needs 0."""
    holder = bpy.data.objects.new("modifier", bpy.data.meshes.new("modifier"))
    bpy.context.scene.collection.objects.link(holder)
    modifier = holder.modifiers.new("to mesh", "VOLUME_TO_MESH")
    modifier.object = volume_object
    modifier.grid_name = grid_name
    modifier.resolution_mode = "GRID"
    modifier.threshold = 0.0
    modifier.adaptivity = 0.0
    mesh = evaluated_mesh(holder)
    bpy.data.objects.remove(holder)
    return mesh


def mesh_by_nodes(volume_object, grid_name):
    """Get Named Grid and Grid to Mesh: the geometry nodes that artists use."""
    tree = bpy.data.node_groups.new("to mesh", "GeometryNodeTree")
    tree.interface.new_socket("Geometry", in_out="OUTPUT", socket_type="NodeSocketGeometry")
    result = tree.nodes.new("NodeGroupOutput")
    volume = tree.nodes.new("GeometryNodeObjectInfo")
    volume.inputs["Object"].default_value = volume_object
    grid = tree.nodes.new("GeometryNodeGetNamedGrid")
    grid.data_type = "FLOAT"
    grid.inputs["Name"].default_value = grid_name
    to_mesh = tree.nodes.new("GeometryNodeGridToMesh")
    to_mesh.inputs["Threshold"].default_value = 0.0
    tree.links.new(volume.outputs["Geometry"], grid.inputs["Volume"])
    tree.links.new(grid.outputs["Grid"], to_mesh.inputs["Grid"])
    tree.links.new(to_mesh.outputs["Mesh"], result.inputs["Geometry"])
    holder = bpy.data.objects.new("nodes", bpy.data.meshes.new("nodes"))
    bpy.context.scene.collection.objects.link(holder)
    holder.modifiers.new("to mesh", "NODES").node_group = tree
    mesh = evaluated_mesh(holder)
    bpy.data.objects.remove(holder)
    return mesh


def vertices(mesh):
    flat = np.empty(3 * len(mesh.vertices), np.float32)
    mesh.vertices.foreach_get("co", flat)
    return flat.reshape(-1, 3).astype(np.float64)


def area_and_volume(mesh):
    """Sums over the triangles; the volume is signed, negative where the faces look inwards."""
    mesh.calc_loop_triangles()
    index = np.empty(3 * len(mesh.loop_triangles), np.int32)
    mesh.loop_triangles.foreach_get("vertices", index)
    a, b, c = np.moveaxis(vertices(mesh)[index.reshape(-1, 3)], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    return area, volume


def open_edges(mesh):
    """Edges that do not belong to exactly two faces."""
    index = np.empty(len(mesh.loops), np.int32)
    mesh.loops.foreach_get("edge_index", index)
    return int((np.bincount(index, minlength=len(mesh.edges)) != 2).sum())


def check_mesh(checks, how, mesh, asked):
    points = vertices(mesh)
    low, high = asked.vertices
    checks.that(low <= len(points) <= high, f"{how}: vertices", len(points), f"{low:.0f} to {high:.0f}")
    if len(points) == 0:
        return
    off = np.abs(np.concatenate([points.min(0), points.max(0)]) - asked.bbox).max()
    checks.near(f"{how}: bounding box off by, voxels", off / asked.voxel_size, 0.0, asked.bbox_tolerance)
    area, volume = area_and_volume(mesh)
    checks.near(f"{how}: area", area, asked.area, asked.tolerance * asked.area)
    checks.near(f"{how}: volume", volume, asked.volume, asked.tolerance * asked.volume)
    edges = open_edges(mesh)
    checks.that(edges == 0, f"{how}: edges without two faces", edges, 0)


def render(mesh, path):
    """A small picture by Cycles on the processor, for people to look at."""
    scene = bpy.context.scene
    shown = bpy.data.objects.new("shown", mesh)
    scene.collection.objects.link(shown)
    for other in scene.objects:
        other.hide_render = other != shown
    points = vertices(mesh)
    centre = Vector(((points.min(0) + points.max(0)) / 2).tolist())
    radius = float(np.linalg.norm(points.max(0) - points.min(0))) / 2
    # y is up in the models; seen from the front, a little from the side and above.
    towards_camera = Vector((0.6, 0.35, -1.0)).normalized()
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    camera.data.angle = math.radians(35)
    camera.data.clip_start, camera.data.clip_end = radius * 1e-3, radius * 100
    camera.location = centre + towards_camera * (radius / math.sin(camera.data.angle / 2))
    right = Vector((0, 1, 0)).cross(towards_camera).normalized()
    up = towards_camera.cross(right)
    # The columns are the camera's axes: it looks along its own -z.
    camera.rotation_euler = Matrix((right, up, towards_camera)).transposed().to_euler()
    scene.camera = camera
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    scene.collection.objects.link(sun)
    sun.data.energy = 2.0
    sun.rotation_euler = (towards_camera + 0.6 * up - 0.5 * right).to_track_quat("Z", "Y").to_euler()
    scene.world = bpy.data.worlds.new("world")
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.35, 0.38, 0.42, 1)
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 16
    scene.render.resolution_x = scene.render.resolution_y = 320
    scene.render.resolution_percentage = 100
    scene.view_settings.view_transform = "Standard"
    scene.render.image_settings.file_format = "PNG"
    scene.render.filepath = os.path.abspath(path)
    bpy.ops.render.render(write_still=True)


def main():
    asked = arguments()
    checks = Checks()
    volume_object, grids = load(asked.file)
    names = [grid.name for grid in grids]
    checks.that(names == [asked.grid], "grids", names, [asked.grid])
    if names == [asked.grid]:
        grid = grids[0]
        checks.that(grid.data_type == "FLOAT", "data type", grid.data_type, "FLOAT")
        axes = [list(row)[:3] for row in grid.matrix_object][:3]
        # Blender keeps the matrix in single precision.
        off = np.abs(np.array(axes) - asked.voxel_size * np.eye(3)).max()
        checks.near("index to world, off by", off, 0.0, 1e-6 * asked.voxel_size)
        field = openvdb_grid(asked.file, asked.grid)
        checks.that(field.gridClass == "level set", "class", field.gridClass, "level set")
        if asked.half_width is not None:
            expected = asked.half_width * asked.voxel_size
            checks.near("background", field.background, expected, 1e-5 * expected)
        mesh = mesh_by_modifier(volume_object, asked.grid)
        check_mesh(checks, "Volume to Mesh", mesh, asked)
        check_mesh(checks, "Grid to Mesh", mesh_by_nodes(volume_object, asked.grid), asked)
        if asked.png:
            render(mesh, asked.png)
    print(f"{checks.passed} passed, {checks.failed} failed")
    return 1 if checks.failed else 0


if __name__ == "__main__":
    sys.exit(main())
