"""The programmes that run on the graphics card, for OpenGL 3.3.

Values of vertices lie in textures TEXTURE_WIDTH wide: vertex v in column v % width, row v / width. Several values of one
vertex (base and directions, the pairs of its ring) lie `rows` further down each.
"""

from __future__ import annotations

TEXTURE_WIDTH = 256

# Both run over the vertices alone and leave their result in a buffer; nothing is rasterised, nothing waits.
POSITIONS_VERTEX = """
#version 330
uniform sampler2D shapes;      // base, then the directions
uniform sampler2D weights;     // one row: the coefficients
uniform int rows;
out vec4 position;
void main() {
    ivec2 at = ivec2(gl_VertexID % WIDTH, gl_VertexID / WIDTH);
    vec3 sum = texelFetch(shapes, at, 0).xyz;
    int count = textureSize(weights, 0).x;
    for (int k = 0; k < count; k++)
        sum += texelFetch(weights, ivec2(k, 0), 0).x * texelFetch(shapes, at + ivec2(0, (k + 1) * rows), 0).xyz;
    position = vec4(sum, 1.0);
}
""".replace("WIDTH", str(TEXTURE_WIDTH))

NORMALS_VERTEX = """
#version 330
uniform sampler2D positions;
uniform isampler2D ring;       // pairs: the two other corners of each face at the vertex, -1 = no more
uniform int rows;
out vec4 normal;
vec3 place(int vertex) {
    return texelFetch(positions, ivec2(vertex % WIDTH, vertex / WIDTH), 0).xyz;
}
void main() {
    ivec2 at = ivec2(gl_VertexID % WIDTH, gl_VertexID / WIDTH);
    vec3 here = texelFetch(positions, at, 0).xyz;
    vec3 sum = vec3(0.0);
    int most = textureSize(ring, 0).y / rows;
    for (int j = 0; j < most; j++) {
        ivec2 pair = texelFetch(ring, at + ivec2(0, j * rows), 0).xy;
        if (pair.x < 0) break;
        sum += cross(place(pair.x) - here, place(pair.y) - here);
    }
    normal = vec4(sum / max(length(sum), 1e-9), 0.0);
}
""".replace("WIDTH", str(TEXTURE_WIDTH))

# The light is worked out at the vertices, which lie a few pixels apart: a software rasteriser pays for every pixel of
# such small triangles several times over. Colours are squared before light is added up and rooted afterwards, near enough
# to what screens do. Light wraps round the edge of the shadow, red farther than blue, as it does under skin; wet tissue
# has a sharp and a dull gloss. The eye is taken to be far away.
TONGUE_VERTEX = """
#version 330
uniform mat4 to_clip;
uniform mat3 to_camera;
uniform int by_value;
uniform vec3 tissue;
uniform vec3 near_colour;
uniform vec3 far_colour;
uniform vec3 unknown;
uniform vec3 ambient;
uniform vec3 light_ways[2];
uniform vec3 light_colours[2];
uniform vec3 between;          // half way between the first light and the eye
in vec4 in_position;
in vec4 in_normal;
in float in_value;             // what the vertex is coloured by, 0 to 1, negative = unknown
in vec2 in_skin;
out vec3 lit;
out vec2 shine;                // the gloss outside, the light inside
out vec2 skin;
const vec3 WRAP = vec3(0.42, 0.16, 0.13);
const vec3 RIM = vec3(0.50, 0.17, 0.15);
vec3 light_on(vec3 n) {
    return ambient * (0.7 + 0.3 * n.y)
        + light_colours[0] * max((dot(n, light_ways[0]) + WRAP) / (1.0 + WRAP), 0.0)
        + light_colours[1] * max((dot(n, light_ways[1]) + WRAP) / (1.0 + WRAP), 0.0);
}
void main() {
    gl_Position = to_clip * in_position;
    vec3 n = to_camera * in_normal.xyz;
    vec3 body = tissue;
    if (by_value == 1) body = in_value < 0.0 ? unknown : mix(near_colour, far_colour, in_value);
    float grazing = 1.0 - max(n.z, 0.0);
    lit = light_on(n) * (body * body + RIM * grazing * grazing * grazing);
    float slope = max(dot(n, between), 0.0);
    shine = vec2(0.46 * pow(slope, 34.0) + 0.13 * pow(slope, 9.0), light_on(-n).y);
    skin = in_skin;
}
"""

TONGUE_FRAGMENT = """
#version 330
uniform sampler2D grain;       // how bright the surface's unevenness is; how it breaks the gloss
uniform vec3 inside;
in vec3 lit;
in vec2 shine;
in vec2 skin;
out vec4 colour;
void main() {
    vec2 uneven = texture(grain, skin).xy * 2.0;
    vec3 outer = lit * uneven.x + shine.x * uneven.y;
    colour = vec4(sqrt(gl_FrontFacing ? outer : inside * inside * shine.y), 1.0);
}
"""

GHOST_VERTEX = """
#version 330
uniform mat4 to_clip;
uniform mat3 to_camera;
in vec4 in_position;
in vec4 in_normal;
out float edge;
void main() {
    gl_Position = to_clip * in_position;
    edge = 1.0 - abs((to_camera * in_normal.xyz).z);
}
"""

GHOST_FRAGMENT = """
#version 330
uniform vec3 tint;
in float edge;
out vec4 colour;
void main() { colour = vec4(tint, 0.12 + 0.55 * edge * edge); }
"""

# Marks: bars, lines, balls and letters, each a quadrilateral in pixels with edges softened over one pixel. One programme
# each: a software rasteriser would take every branch of a common one in every pixel.
_MARK_HEAD = """
#version 330
uniform vec2 size;
in vec4 in_ends;               // two points, pixels from the upper left
in vec2 in_depths;
in float in_thickness;         // of a line; radius of a ball
in vec4 in_colour;
in vec4 in_letter;             // corners in the atlas
flat out vec4 ends;
flat out float thickness;
flat out vec4 tint;
out vec2 at;
out vec2 letter;
void put(vec2 place, float depth) {
    at = place;
    ends = in_ends;
    thickness = in_thickness;
    tint = in_colour;
    letter = vec2(0.0);
    gl_Position = vec4(2.0 * at.x / size.x - 1.0, 1.0 - 2.0 * at.y / size.y, depth, 1.0);
}
"""

# Upper and lower edges are level, the sides may slant: in_letter begins with the lower edge's ends.
BAR_VERTEX = (
    _MARK_HEAD
    + """
void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    vec2 side = mix(vec2(in_ends.x, in_letter.x), vec2(in_ends.z, in_letter.y), corner.x);
    put(vec2(mix(side.x, side.y, corner.y), mix(in_ends.y, in_ends.w, corner.y)), in_depths.x);
}
"""
)

BAR_FRAGMENT = """
#version 330
flat in vec4 tint;
out vec4 colour;
void main() { colour = tint; }
"""

LETTER_VERTEX = (
    _MARK_HEAD
    + """
void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    put(mix(in_ends.xy, in_ends.zw, corner), in_depths.x);
    letter = mix(in_letter.xy, in_letter.zw, corner);
}
"""
)

LETTER_FRAGMENT = """
#version 330
uniform sampler2D letters;
flat in vec4 tint;
in vec2 letter;
out vec4 colour;
void main() { colour = vec4(tint.rgb, tint.a * texture(letters, letter).r); }
"""

# Hardly longer than it is, so that the pieces of a curve do not show where they meet.
LINE_VERTEX = (
    _MARK_HEAD
    + """
void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    vec2 along = in_ends.zw - in_ends.xy;
    float far = length(along);
    along = far > 0.0 ? along / far : vec2(1.0, 0.0);
    vec2 aside = vec2(-along.y, along.x) * (0.5 * in_thickness + 1.0) * (2.0 * corner.y - 1.0);
    float depth = mix(in_depths.x, in_depths.y, corner.x);
    put(mix(in_ends.xy - along * 0.3, in_ends.zw + along * 0.3, corner.x) + aside, depth);
}
"""
)

LINE_FRAGMENT = """
#version 330
flat in vec4 ends;
flat in float thickness;
flat in vec4 tint;
in vec2 at;
out vec4 colour;
void main() {
    vec2 along = ends.zw - ends.xy;
    float share = clamp(dot(at - ends.xy, along) / max(dot(along, along), 1e-6), 0.0, 1.0);
    float far = length(at - ends.xy - share * along);
    colour = vec4(tint.rgb, tint.a * clamp(0.5 * thickness + 0.5 - far, 0.0, 1.0));
}
"""

BALL_VERTEX = (
    _MARK_HEAD
    + """
void main() {
    vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1);
    put(in_ends.xy + (in_thickness + 1.0) * (2.0 * corner - 1.0), in_depths.x);
}
"""
)

BALL_FRAGMENT = """
#version 330
flat in vec4 ends;
flat in float thickness;
flat in vec4 tint;
in vec2 at;
out vec4 colour;
void main() {
    vec2 off = at - ends.xy;
    vec2 side = off / max(thickness, 1e-3);
    float up = sqrt(max(1.0 - dot(side, side), 0.0));
    float light = 0.45 + 0.6 * max(dot(vec3(side.x, -side.y, up), vec3(-0.42, 0.62, 0.66)), 0.0);
    vec2 shine = side - vec2(-0.35, -0.42);
    float gloss = 0.7 * max(1.0 - 7.0 * dot(shine, shine), 0.0);
    colour = vec4(tint.rgb * light + gloss, tint.a * clamp(thickness + 0.5 - length(off), 0.0, 1.0));
}
"""
