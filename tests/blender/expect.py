"""Prints the arguments of check.py that a level set made from a closed mesh has to meet.

    expect.py INFO.json MESH.obj

Grid name, voxel size and half width come from `vdb-edit info --json`; everything about the surface comes from the mesh
itself, so that an error of the conversion cannot hide in its own report.
"""

import json
import math
import sys

# A mesh with one vertex in every voxel that the surface crosses has as many vertices as the surface crosses grid lines,
# up to its Euler number. A piece of area A with the normal n crosses A (|n_x| + |n_y| + |n_z|) / voxel² of them. Features
# thinner than a voxel, which no grid of that size holds, are the reason for the margin.
VERTEX_MARGIN = 0.03


def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def minus(a, b):
    return tuple(x - y for x, y in zip(a, b))


def read_obj(path):
    """Vertices, and the triangles of a fan over every face (the models here have no concave faces)."""
    points, triangles = [], []
    with open(path, encoding="ascii") as lines:
        for line in lines:
            key, *words = line.split() or [""]
            if key == "v":
                points.append(tuple(float(word) for word in words[:3]))
            elif key == "f":
                corners = [int(word.split("/")[0]) - 1 for word in words]
                triangles += [(corners[0], b, c) for b, c in zip(corners[1:], corners[2:])]
    return points, triangles


def main():
    info_path, mesh_path = sys.argv[1:]
    with open(info_path, encoding="utf-8") as file:
        grids = json.load(file)["grids"]
    if len(grids) != 1:
        raise SystemExit(f"{info_path}: {len(grids)} grids, expected 1")
    grid = grids[0]
    voxel = grid["voxel_size"]
    if isinstance(voxel, list):
        voxel = voxel[0]
    points, triangles = read_obj(mesh_path)
    area = volume = crossings = 0.0
    for i, j, k in triangles:
        a, b, c = points[i], points[j], points[k]
        normal = cross(minus(b, a), minus(c, a))
        area += math.hypot(*normal) / 2
        crossings += sum(map(abs, normal)) / 2
        volume += sum(x * y for x, y in zip(a, cross(b, c))) / 6
    vertices = crossings / voxel**2
    box = [pick(point[axis] for point in points) for pick in (min, max) for axis in range(3)]
    print(
        f"--grid={grid['name']}",
        f"--voxel-size={voxel!r}",
        f"--half-width={grid['half_width']!r}",
        f"--bbox={','.join(map(repr, box))}",
        f"--vertices={vertices * (1 - VERTEX_MARGIN):.0f},{vertices * (1 + VERTEX_MARGIN):.0f}",
        f"--area={area!r}",
        f"--volume={volume!r}",
        sep="\n",
    )


if __name__ == "__main__":
    main()
