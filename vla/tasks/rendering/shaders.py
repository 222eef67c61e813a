"""GLSL programs of the fast renderer, for one model's number of lights."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

POSE = 3  # texels of an element's pose: rows of a 3 x 4 matrix
TEXELS = 4  # of an element's appearance: colour, light, axes that follow the eye, texture coordinates per metre
ROWS = 6  # of a light: ambient, diffuse, specular, position, direction, attenuation
CAMERA = 20  # floats of a camera's block before shadow projections and lights: projection and eye
Skin = Literal["none", "2d", "cube"]

PLACE = """
uniform sampler2D poses;
uniform sampler2D table;
in vec3 in_position;
in vec3 in_normal;
in vec3 in_coordinate;
in float in_element;

// The place of a vertex in the world; the sky and infinite planes move along with the eye, by `shift` in their frame.
vec3 place(int element, vec3 eye, out mat3 turn, out vec3 shift) {
    vec4 x = texelFetch(poses, ivec2(0, element), 0);
    vec4 y = texelFetch(poses, ivec2(1, element), 0);
    vec4 z = texelFetch(poses, ivec2(2, element), 0);
    turn = mat3(x.x, y.x, z.x, x.y, y.y, z.y, x.z, y.z, z.z);
    vec3 origin = vec3(x.w, y.w, z.w);
    shift = ((eye - origin) * turn) * texelFetch(table, ivec2(2, element), 0).xyz;
    return turn * (in_position + shift) + origin;
}
"""

SHADOW_PROGRAM = {
    "vertex_shader": f"""#version 330
{PLACE}
uniform mat4 projection;
uniform vec3 lamp;
void main() {{
    mat3 turn;
    vec3 shift;
    gl_Position = projection * vec4(place(int(in_element), lamp, turn, shift), 1.0);
}}""",
    "fragment_shader": """#version 330
void main() {}""",
}

# OpenGL's fixed-function lighting with a local viewer, as MuJoCo's classic renderer uses it.
LIGHT = """
vec3 shine(int number, vec3 place, vec3 normal, vec3 colour, vec4 material) {
    int first = number * ROWS;
    vec3 towards = -lights[first + 4].xyz;
    float strength = 1.0;
    if (lights[first + 3].w > 0.5) {
        vec3 offset = lights[first + 3].xyz - place;
        float far = length(offset);
        towards = offset / far;
        vec4 fading = lights[first + 5];
        float inside = dot(-towards, lights[first + 4].xyz);
        strength = inside < lights[first + 4].w ? 0.0 : pow(max(inside, 0.0), fading.w);
        strength /= fading.x + fading.y * far + fading.z * far * far;
    }
    float facing = dot(normal, towards);
    vec3 sum = (lights[first].rgb + max(facing, 0.0) * lights[first + 1].rgb) * colour;
    float half_way = dot(normal, normalize(towards + normalize(eye.xyz - place)));
    float glance = half_way > 0.0 ? pow(half_way, material.z) : 0.0;  // pow(0, 0) is undefined
    return strength * (sum + (facing > 0.0 ? glance * material.y : 0.0) * lights[first + 2].rgb);
}
"""


def scene_program(
    lights: int, lamps: Mapping[int, bool], skin: Skin, pixel: bool, soft: int, coarser: int
) -> dict[str, str]:
    """Return the sources of the shaders of pictures.

    Args:
        lights: number of lights, the headlight first.
        lamps: number of each light with a shadow map → whether it is a spot light.
        skin: kind of texture.
        pixel: whether to compute light per pixel instead of per vertex.
        soft: texels around the nearest one over which shadows are averaged.
        coarser: bias on the mipmap level of textures.
    """
    count, spots = len(lamps), list(lamps.values())
    header = f"""#version 330
layout(std140) uniform Camera {{
    mat4 projection;
    vec4 eye;
    {f"mat4 shadow_projection[{count}];" if count else ""}
    vec4 lights[{lights * ROWS}];
}};
{LIGHT.replace("ROWS", str(ROWS))}"""
    fields = {"none": [], "2d": ["vec2 coordinate"], "cube": ["vec3 coordinate"]}[skin]
    fields += [f"vec{4 if spot else 3} shadow_at{number}" for number, spot in enumerate(spots)]
    fields += ["vec3 position", "vec3 normal", "vec3 colour", "vec4 material"] if pixel else []
    fields += [] if pixel else ["vec3 base", *(f"vec3 lit{number}" for number in range(count))]
    shading = _shading(lights, list(lamps))
    return {
        "vertex_shader": header + _vertex(fields, shading, spots, skin, pixel),
        "fragment_shader": header + _fragment(fields, shading, count, skin, pixel, soft, coarser),
    }


def _declarations(qualifier: str, names: Sequence[str]) -> str:
    return "\n".join(f"{qualifier} {name};" for name in names)


def _shading(lights: int, lamps: Sequence[int]) -> str:
    """Return statements that set `base` and every `lit`, clamped as OpenGL clamps a vertex's colour."""
    shine = [f"shine({number}, position, normal, colour, material)" for number in range(lights)]
    terms = [shine[number] for number in range(lights) if number not in lamps]
    sums = {"base": " + ".join(["vec3(material.w) + material.x * colour", *terms])}
    sums |= {f"lit{index}": shine[number] for index, number in enumerate(lamps)}
    return "\n    ".join(f"{name} = clamp({value}, 0.0, 1.0);" for name, value in sums.items())


def _vertex(fields: Sequence[str], shading: str, spots: Sequence[bool], skin: Skin, pixel: bool) -> str:
    lookups = [
        f"shadow_at{number} = (shadow_projection[{number}] * vec4(position, 1.0)).{'xyzw' if spot else 'xyz'};"
        for number, spot in enumerate(spots)
    ]
    expression = "in_coordinate + shift * texelFetch(table, ivec2(3, element), 0).xyz"
    coordinate = {"none": "", "2d": f"coordinate = ({expression}).xy;", "cube": f"coordinate = {expression};"}[skin]
    return f"""
{PLACE}
{_declarations("out", fields)}
void main() {{
    int element = int(in_element);
    mat3 turn;
    vec3 shift;
    {"" if pixel else "vec3 position, normal, colour; vec4 material;"}
    position = place(element, eye.xyz, turn, shift);
    normal = turn * in_normal;
    colour = texelFetch(table, ivec2(0, element), 0).rgb;
    material = texelFetch(table, ivec2(1, element), 0);
    {coordinate}
    {"" if pixel else shading}
    {" ".join(lookups)}
    gl_Position = projection * vec4(position, 1.0);
}}"""


def _fragment(fields: Sequence[str], shading: str, count: int, skin: Skin, pixel: bool, soft: int, coarser: int) -> str:
    samplers = [f"sampler2DShadow shadow{number}" for number in range(count)]
    samplers += {"none": [], "2d": ["sampler2D skin"], "cube": ["samplerCube skin"]}[skin]
    names = ", ".join(["base", *(f"lit{number}" for number in range(count))])
    local = f"vec3 {names};\n    {shading.replace('normal,', 'normalize(normal),')}" if pixel else ""
    lamps = [f"sum += lit{lamp} * max(unshadowed, shown(shadow{lamp}, shadow_at{lamp}));" for lamp in range(count)]
    lookup = f"texture(skin, coordinate{f', {coarser}.0' if coarser else ''})"
    return f"""
uniform float unshadowed;
uniform float alpha;
{_declarations("uniform", samplers)}
{_declarations("in", fields)}
out vec4 picture;
{_shadow_lookup("vec3", soft)}
{_shadow_lookup("vec4", soft)}
void main() {{
    {local}
    vec3 sum = base;
    {" ".join(lamps)}
    picture = vec4(sum, alpha) * {"vec4(1.0)" if skin == "none" else lookup};
}}"""


def _shadow_lookup(kind: str, soft: int) -> str:
    """Return the GLSL function that looks up the share of a place's surroundings that is lit by a lamp; for a spot
    light, the place is a vec4 and is divided by its last component."""
    look, scale, end = ("texture", "1.0", "") if kind == "vec3" else ("textureProj", "at.w", ", 0.0")
    taps = [(x, y) for x in range(-soft, soft + 1) for y in range(-soft, soft + 1)]
    sums = [f"{look}(map, at + {kind}({x}.0 * texel.x, {y}.0 * texel.y, 0.0{end}))" for x, y in taps]
    average = f"vec2 texel = {scale} / vec2(textureSize(map, 0));\n    return ({' + '.join(sums)}) / {len(taps)}.0;"
    return f"float shown(sampler2DShadow map, {kind} at) {{\n    {average if soft else f'return {look}(map, at);'}\n}}"
