"""Worker in Blender's Python (module bpy) that answers the requests of `blender.Blender`.

Reads one JSON object a line from standard input and replies to each with one line. Imports no
module of LightSim, since bpy requires another version of NumPy.
"""

from __future__ import annotations

import importlib
import json
import math
import os
import sys
import traceback
from pathlib import Path
from typing import IO, Any

import numpy as np


class Worker:
    """One Blender scene, modified by requests."""

    def __init__(self) -> None:
        self.bpy: Any = importlib.import_module("bpy")
        self.bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene: Any = self.bpy.context.scene
        self.materials: dict[str, Any] = {}
        self.finishes: dict[str, Any] = {}
        self.shots = 0
        _settings(self.scene)
        self.camera = self._object("camera", self.bpy.data.cameras.new("camera"))
        self.scene.camera = self.camera
        self.sun = self._object("sun", self.bpy.data.lights.new("sun", "SUN"))
        self.world = self.bpy.data.worlds.new("world")
        self.scene.world = self.world
        _world_nodes(self.world)

    def _object(self, name: str, data: Any) -> Any:
        scene_object = self.bpy.data.objects.new(name, data)
        self.scene.collection.objects.link(scene_object)
        return scene_object

    def reply_to(self, request: dict[str, Any]) -> dict[str, str]:
        """Run the method `do_X` for X = `request["do"]`; return its reply."""
        return getattr(self, f"do_{request['do']}")(request) or {}

    def do_start(self, request: dict[str, Any]) -> dict[str, str]:
        """Return the version of Blender, which proves that bpy works."""
        return {"version": self.bpy.app.version_string}

    def do_finish(self, request: dict[str, Any]) -> None:
        """Add a material for `do_part`, from an .npz file with periodic textures."""
        name = request["name"]
        with np.load(request["path"]) as textures:
            self.finishes[name] = _finish(self.bpy, name, textures, request)

    def do_part(self, request: dict[str, Any]) -> None:
        """Add a mesh with flat faces and the material of a `do_finish`."""
        with np.load(request["path"]) as arrays:
            mesh = _mesh(self.bpy, request["name"], arrays)
        mesh.materials.append(self.finishes[request["finish"]])
        self._object(request["name"], mesh)

    def do_place(self, request: dict[str, Any]) -> None:
        """Set the pose of an object."""
        scene_object = self.bpy.data.objects[request["name"]]
        scene_object.matrix_world = np.array(request["world_from_object"]).T.tolist()

    def do_mesh(self, request: dict[str, Any]) -> None:
        """Add a mesh from the .npz file of a `corner_mesh.CornerMesh`."""
        name = request["name"]
        with np.load(request["path"]) as arrays:
            mesh = _mesh(self.bpy, name, arrays)
            texture = arrays.get("texture")
        self.materials[name] = _material(self.bpy, name, texture)
        mesh.materials.append(self.materials[name])
        scene_object = self._object(name, mesh)
        scene_object.visible_camera = request["is_visible"]
        # Blender's offset would move shadow rays off the surface, unlike in the other renderers.
        scene_object.cycles.shadow_terminator_geometry_offset = 0.0

    def do_remove(self, request: dict[str, Any]) -> None:
        """Remove the meshes whose name starts with a prefix, with their materials and textures."""
        data = self.bpy.data
        for name in [n for n in self.materials if n.startswith(request["prefix"])]:
            data.meshes.remove(data.objects[name].data)
            data.materials.remove(self.materials.pop(name))
            if name in data.images:
                data.images.remove(data.images[name])

    def do_shot(self, request: dict[str, Any]) -> None:
        """Render one image into a .npy file, rows from the top.

        Without `sky` in the request, the light is that of the last shot.
        """
        for material in self.materials.values():
            _choose_surface(material, request["surfaces"])
        self._set_camera(request)
        if "sky" in request:
            self._set_light(request)
        cycles = self.scene.cycles
        cycles.samples = request["samples"]
        cycles.seed = request["seed"]
        for kind in ("max", "diffuse", "glossy"):
            setattr(cycles, f"{kind}_bounces", request["bounces"])
        is_wide = request["is_antialiased"]
        # Cycles' box filter has a fixed width of 1: a narrow Gaussian samples the pixel's centre.
        cycles.pixel_filter_type = "BOX" if is_wide else "GAUSSIAN"
        cycles.filter_width = 0.01
        out = Path(request["out"])
        self.scene.render.filepath = str(out.with_suffix(".exr"))
        self.bpy.ops.render.render(write_still=True)
        np.save(out, self._read(out.with_suffix(".exr")))

    def _read(self, path: Path) -> np.ndarray:
        image = self.bpy.data.images.load(str(path))
        width, height = image.size
        pixels = np.empty(width * height * 4, dtype=np.float32)
        image.pixels.foreach_get(pixels)
        self.bpy.data.images.remove(image)
        # Blender's first row is the lowest.
        return pixels.reshape(height, width, 4)[::-1, :, :3].copy()

    def _set_camera(self, request: dict[str, Any]) -> None:
        width, height = request["size_px"]
        fx, fy, cx, cy = request["intrinsics_px"]
        render, lens = self.scene.render, self.camera.data
        render.resolution_x, render.resolution_y = width, height
        render.pixel_aspect_x, render.pixel_aspect_y = max(1.0, fy / fx), max(1.0, fx / fy)
        lens.sensor_fit, lens.sensor_width = "HORIZONTAL", 36.0
        lens.lens = fx / width * 36.0
        # Shifts are in units of the image's width, in both directions.
        lens.shift_x = (width / 2 - cx) / width
        lens.shift_y = (cy - height / 2) / width
        lens.clip_start, lens.clip_end = 0.01, 1.0e5
        # From OpenCV's camera axes to Blender's, which has y up and looks along -z.
        pose = np.array(request["world_from_camera"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
        self.camera.matrix_world = pose.T.tolist()

    def _set_light(self, request: dict[str, Any]) -> None:
        sun = request["sun"]
        light = self.sun.data
        if sun is None:
            light.energy = 0.0
        else:
            level = max(sun["irradiance"])
            # Blender separates the strength of a lamp from its colour.
            light.energy = level
            light.color = [value / level for value in sun["irradiance"]]
            light.angle = math.radians(2 * sun["angular_radius_deg"])
            self.sun.matrix_world = _turned_towards(np.array(sun["direction"])).T.tolist()
        light.update_tag()
        _set_disc(self.world, sun)
        with np.load(request["sky"]) as arrays:
            self.shots += 1
            _set_world(self.bpy, self.world, arrays, f"sky{self.shots}:")


def _settings(scene: Any) -> None:
    """Set unbiased rendering: nothing clamped, blurred, denoised or stopped early."""
    scene.render.engine = "CYCLES"
    scene.render.resolution_percentage = 100
    # Blender's render data of unchanged meshes is reused between shots.
    scene.render.use_persistent_data = True
    scene.render.image_settings.file_format = "OPEN_EXR"
    scene.render.image_settings.color_depth = "32"
    scene.render.image_settings.exr_codec = "NONE"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_adaptive_sampling = False
    cycles.use_denoising = False
    cycles.sample_clamp_direct = cycles.sample_clamp_indirect = 0.0
    cycles.blur_glossy = 0.0
    cycles.light_sampling_threshold = 0.0
    cycles.caustics_reflective = True
    # No material of a twin is transparent.
    cycles.transmission_bounces = cycles.volume_bounces = cycles.transparent_max_bounces = 0


def _mesh(bpy: Any, name: str, arrays: Any) -> Any:
    """Return a Blender mesh with separate vertices of each face.

    Without `normals` its faces are flat. `colour`, `roughness` and `metallic` are optional.
    """
    corners = len(arrays["vertices"])
    mesh = bpy.data.meshes.new(name)
    mesh.vertices.add(corners)
    mesh.vertices.foreach_set("co", arrays["vertices"].ravel())
    mesh.loops.add(corners)
    mesh.loops.foreach_set("vertex_index", np.arange(corners, dtype=np.int32))
    mesh.polygons.add(corners // 3)
    mesh.polygons.foreach_set("loop_start", np.arange(0, corners, 3, dtype=np.int32))
    mesh.update(calc_edges=True)
    is_smooth = "normals" in arrays
    mesh.polygons.foreach_set("use_smooth", np.full(corners // 3, is_smooth))
    if is_smooth:
        normals = mesh.attributes.new("custom_normal", "FLOAT_VECTOR", "CORNER")
        normals.data.foreach_set("vector", arrays["normals"].ravel())
    # Blender's v points up.
    uv = arrays["uv"].copy()
    uv[:, 1] = 1 - uv[:, 1]
    mesh.uv_layers.new(name="uv").data.foreach_set("uv", uv.ravel())
    if "colour" in arrays:
        colour = np.concatenate([arrays["colour"], np.ones((corners, 1), np.float32)], axis=1)
        attribute = mesh.attributes.new("colour", "FLOAT_COLOR", "CORNER")
        attribute.data.foreach_set("color", colour.ravel())
    for key in ("roughness", "metallic"):
        if key in arrays:
            attribute = mesh.attributes.new(key, "FLOAT", "FACE")
            attribute.data.foreach_set("value", arrays[key])
    return mesh


def _image(bpy: Any, name: str, pixels: np.ndarray) -> Any:
    """Return a linear image; Blender's first row is the lowest."""
    height, width = pixels.shape[:2]
    image = bpy.data.images.new(name, width, height, float_buffer=True, is_data=True)
    full = np.concatenate([pixels[::-1], np.ones((height, width, 1), np.float32)], axis=2)
    image.pixels.foreach_set(np.ascontiguousarray(full, dtype=np.float32).ravel())
    image.update()
    return image


def _material(bpy: Any, name: str, texture: np.ndarray | None) -> Any:
    """Return a material with Principled, diffuse and white-to-the-camera shaders side by side."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    tree = material.node_tree
    nodes, links = tree.nodes, tree.links
    nodes.clear()
    nodes.new("ShaderNodeOutputMaterial").name = "output"
    if texture is None:
        source = _attribute(nodes, "colour", "Color")
    else:
        picture = nodes.new("ShaderNodeTexImage")
        picture.image = _image(bpy, name, texture)
        picture.interpolation, picture.extension = "Linear", "EXTEND"
        source = picture.outputs["Color"]
    principled = nodes.new("ShaderNodeBsdfPrincipled")
    principled.name = "principled"
    links.new(principled.inputs["Base Color"], source)
    inputs = {"roughness": "Roughness", "metallic": "Metallic"}
    for key, name_of_input in inputs.items():
        links.new(principled.inputs[name_of_input], _attribute(nodes, key, "Fac"))
    for key in ("diffuse", "white"):
        nodes.new("ShaderNodeBsdfDiffuse").name = key
    links.new(nodes["diffuse"].inputs["Color"], source)
    # White for camera rays only: reflections between surfaces have their base colour.
    mixed = nodes.new("ShaderNodeMixRGB")
    links.new(mixed.inputs[0], nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"])
    links.new(mixed.inputs[1], source)
    mixed.inputs[2].default_value = (1.0, 1.0, 1.0, 1.0)
    links.new(nodes["white"].inputs["Color"], mixed.outputs[0])
    return material


def _finish(bpy: Any, name: str, textures: Any, request: dict[str, Any]) -> Any:
    """Return a Principled material with periodic textures of base colour and roughness."""
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    nodes, links = material.node_tree.nodes, material.node_tree.links
    nodes.clear()
    principled = nodes.new("ShaderNodeBsdfPrincipled")
    for key, value in request["inputs"].items():
        principled.inputs[key].default_value = value
    for key, pixels in textures.items():
        picture = nodes.new("ShaderNodeTexImage")
        picture.image = _image(bpy, f"{name}:{key}", pixels)
        picture.interpolation, picture.extension = "Linear", "REPEAT"
        links.new(principled.inputs[key], picture.outputs["Color"])
    output = nodes.new("ShaderNodeOutputMaterial")
    links.new(output.inputs["Surface"], principled.outputs["BSDF"])
    return material


def _attribute(nodes: Any, name: str, output: str) -> Any:
    node = nodes.new("ShaderNodeAttribute")
    node.attribute_name = name
    return node.outputs[output]


def _choose_surface(material: Any, surfaces: str) -> None:
    tree = material.node_tree
    surface = tree.nodes["output"].inputs["Surface"]
    shader = tree.nodes[surfaces].outputs["BSDF"]
    if not surface.links or surface.links[0].from_socket != shader:
        tree.links.new(surface, shader)


def _world_nodes(world: Any) -> None:
    """Build the sky that gives light, and for camera rays the dome, with the sun's disc."""
    world.use_nodes = True
    nodes, links = world.node_tree.nodes, world.node_tree.links
    nodes.clear()
    shaders = []
    for key in ("light", "seen"):
        picture = nodes.new("ShaderNodeTexEnvironment")
        picture.name = key
        background = nodes.new("ShaderNodeBackground")
        links.new(background.inputs["Color"], picture.outputs["Color"])
        shaders.append(background.outputs[0])
    both = nodes.new("ShaderNodeAddShader")
    links.new(both.inputs[0], shaders[1])
    links.new(both.inputs[1], _disc(nodes, links))
    mixed = nodes.new("ShaderNodeMixShader")
    links.new(mixed.inputs[0], nodes.new("ShaderNodeLightPath").outputs["Is Camera Ray"])
    links.new(mixed.inputs[1], shaders[0])
    links.new(mixed.inputs[2], both.outputs[0])
    links.new(nodes.new("ShaderNodeOutputWorld").inputs["Surface"], mixed.outputs[0])
    world.cycles.sampling_method = "MANUAL"


def _disc(nodes: Any, links: Any) -> Any:
    """Return the shader of a disc around a direction; black at first."""
    along = nodes.new("ShaderNodeVectorMath")
    along.name, along.operation = "towards", "DOT_PRODUCT"
    links.new(along.inputs[0], nodes.new("ShaderNodeTexCoord").outputs["Generated"])
    inside = nodes.new("ShaderNodeMath")
    inside.name, inside.operation = "inside", "GREATER_THAN"
    links.new(inside.inputs[0], along.outputs["Value"])
    disc = nodes.new("ShaderNodeBackground")
    disc.name = "disc"
    disc.inputs["Color"].default_value = (0.0, 0.0, 0.0, 1.0)
    links.new(disc.inputs["Strength"], inside.outputs[0])
    return disc.outputs[0]


def _set_disc(world: Any, sun: dict[str, Any] | None) -> None:
    """Make the sun's disc visible to camera rays, which see no lamp, if the request has a disc."""
    nodes = world.node_tree.nodes
    colour = nodes["disc"].inputs["Color"]
    if sun is None or not sun.get("has_disc"):
        colour.default_value = (0.0, 0.0, 0.0, 1.0)
        return
    radius = math.radians(sun["angular_radius_deg"])
    # Irradiance of a uniform disc of angular radius r is radiance x pi x sin(r)^2.
    area = math.pi * math.sin(radius) ** 2
    colour.default_value = (*(value / area for value in sun["irradiance"]), 1.0)
    towards = np.array(sun["direction"])
    nodes["towards"].inputs[1].default_value = (towards / np.linalg.norm(towards)).tolist()
    nodes["inside"].inputs[1].default_value = math.cos(radius)


def _set_world(bpy: Any, world: Any, arrays: Any, prefix: str) -> None:
    """Load the sky's images; Cycles caches images by name, so each sky has a new name."""
    for key in ("light", "seen"):
        node = world.node_tree.nodes[key]
        old = node.image
        node.image = _image(bpy, prefix + key, arrays[key])
        if old is not None:
            bpy.data.images.remove(old)
    columns = 2 * arrays["light"].shape[1]
    # Resolution of importance sampling, bounded for memory.
    world.cycles.sample_map_resolution = min(4096, max(256, columns))
    world.update_tag()


def _turned_towards(direction: np.ndarray) -> np.ndarray:
    """Return a pose whose z axis has the given direction, since lamps emit along -z."""
    z = direction / np.linalg.norm(direction)
    x = np.cross([1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0], z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    return pose


def serve(requests: IO[str], replies: IO[str]) -> None:
    """Reply to requests until their end, one line of JSON each; Blender starts with the first.

    The reply of a request that fails has `error` and `trace`, and the next request is read.
    """
    worker = None
    for line in requests:
        try:
            worker = worker or Worker()
            reply = worker.reply_to(json.loads(line))
        except Exception as error:  # noqa: BLE001 - every failure is reported to the caller
            reply = {"error": f"{type(error).__name__}: {error}", "trace": traceback.format_exc()}
        replies.write(json.dumps(reply) + "\n")
        replies.flush()


if __name__ == "__main__":
    # Blender prints to standard output, so replies use a duplicate of its descriptor.
    own = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    serve(sys.stdin, own)
