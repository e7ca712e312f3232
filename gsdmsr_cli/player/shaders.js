// The programs of the graphics card; SPLATTING has the constants of splatting.

/* global SPLATTING */

export const TABLE_WIDTH = 2048; // texels of a row of a table; every WebGL2 has as many

/** What the first program writes for each splat: names and how many numbers. */
export const PLACED = { centre: 2, longer: 2, shorter: 2, colour: 4, depth: 1 };

const number = (value) => (Number.isInteger(value) ? `${value}.0` : String(value));

function head(defined = {}) {
  const values = Object.entries(SPLATTING).map(([name, value]) => `#define ${name} ${number(value)}`);
  const counts = Object.entries(defined).map(([name, value]) => `#define ${name} ${value}`);
  return ["#version 300 es", "precision highp float;", "precision highp int;",
    "precision highp sampler2D;", ...values, ...counts, ""].join("\n");
}

/**
 * Moves a splat, projects it and finds its colour; run once a splat, without drawing.
 *
 * counts has DEGREE, MOVING, NEIGHBOURS, LIVES, OWN (curves of all kinds but colours), COLOURS.
 */
export const placeShader = (counts) => `${head({ ...counts, TABLE_WIDTH })}
layout(location = 0) in uint splat;
uniform sampler2D geometry, rest, lives, followed, bodies, curves;
uniform sampler2D own, own_ends, own_which, colours, colour_ends, colour_which;
uniform mat4 world_to_camera;
uniform vec2 focal, middle, size;
uniform vec3 eye;
uniform float time;
out vec2 centre, longer, shorter;
out vec4 colour;
out float depth;

const int COEFFICIENTS = (DEGREE + 1) * (DEGREE + 1);

vec4 texel(sampler2D table, int index) {
  return texelFetch(table, ivec2(index % TABLE_WIDTH, index / TABLE_WIDTH), 0);
}

vec4 product(vec4 a, vec4 b) {
  return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(
    1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void follow_bodies(int row, inout vec3 mean, inout vec4 quat, inout vec3 log_scales) {
  vec4 turn = vec4(0.0), to_x = turn, to_y = turn, to_z = turn, growth = turn;
  for (int k = 0; k < NEIGHBOURS; k++) {
    vec2 one = texel(followed, row * NEIGHBOURS + k).xy;
    int first = 5 * int(one.x);
    turn += one.y * texel(bodies, first);
    to_x += one.y * texel(bodies, first + 1);
    to_y += one.y * texel(bodies, first + 2);
    to_z += one.y * texel(bodies, first + 3);
    growth += one.y * texel(bodies, first + 4);
  }
  vec4 here = vec4(mean, 1.0);
  mean += vec3(dot(to_x, here), dot(to_y, here), dot(to_z, here));
  quat += product(turn, quat);
  log_scales += growth.xyz;
}

float curve(sampler2D which, int entry) {
  return texel(curves, int(texel(which, entry).x)).x;
}

vec4 sum_of_curves(int from, int end) {
  vec4 sum = vec4(0.0);
  for (int k = from; k < end; k++) sum += curve(own_which, k) * texel(own, k);
  return sum;
}

float life(int row) {
  vec4 span = texel(lives, row);
  float early = max(0.0, span.x - time) * exp(-span.z);
  float late = max(0.0, time - span.y) * exp(-span.w);
  return exp(-early * early - late * late);
}

vec3 coefficient(int row, int k) {
  vec3 found = k == 0 ? texel(geometry, 4 * row + 3).xyz
    : texel(rest, row * (COEFFICIENTS - 1) + k - 1).xyz;
#if COLOURS > 0
  if (row < MOVING) {
    int end = int(texel(colour_ends, row).x);
    for (int n = row > 0 ? int(texel(colour_ends, row - 1).x) : 0; n < end; n++) {
      found += curve(colour_which, n) * texel(colours, n * COEFFICIENTS + k).xyz;
    }
  }
#endif
  return found;
}

vec3 colour_towards(int row, vec3 d) {
  vec3 sum = 0.28209479177387814 * coefficient(row, 0);
#if DEGREE > 0
  sum += 0.4886025119029199 * (-d.y * coefficient(row, 1) + d.z * coefficient(row, 2)
    - d.x * coefficient(row, 3));
#endif
#if DEGREE > 1
  vec3 s = d * d;
  sum += 1.0925484305920792 * (d.x * d.y * coefficient(row, 4) - d.y * d.z * coefficient(row, 5)
      - d.x * d.z * coefficient(row, 7))
    + 0.31539156525252005 * (2.0 * s.z - s.x - s.y) * coefficient(row, 6)
    + 0.5462742152960396 * (s.x - s.y) * coefficient(row, 8);
#endif
#if DEGREE > 2
  sum += -0.5900435899266435 * (d.y * (3.0 * s.x - s.y) * coefficient(row, 9)
      + d.x * (s.x - 3.0 * s.y) * coefficient(row, 15))
    + 2.890611442640554 * d.x * d.y * d.z * coefficient(row, 10)
    - 0.4570457994644658 * (4.0 * s.z - s.x - s.y)
      * (d.y * coefficient(row, 11) + d.x * coefficient(row, 13))
    + 0.3731763325901154 * d.z * (2.0 * s.z - 3.0 * s.x - 3.0 * s.y) * coefficient(row, 12)
    + 1.445305721320277 * d.z * (s.x - s.y) * coefficient(row, 14);
#endif
  return max(0.5 + sum, 0.0);
}

/** The covariance on the screen as its xx, xy, yy [px^2]. */
vec3 project(vec3 seen, mat3 axes) {
  vec2 limit = FRUSTUM_MARGIN * 0.5 * size / focal;
  vec2 slope = clamp(seen.xy / seen.z, -limit, limit);
  mat3 rows = transpose(mat3(world_to_camera) * axes);
  vec3 along_x = focal.x / seen.z * (rows[0] - slope.x * rows[2]);
  vec3 along_y = focal.y / seen.z * (rows[1] - slope.y * rows[2]);
  return vec3(dot(along_x, along_x) + DILATION, dot(along_x, along_y), dot(along_y, along_y) + DILATION);
}

void main() {
  int row = int(splat);
  vec4 first = texel(geometry, 4 * row);
  vec3 mean = first.xyz;
  float opacity = first.w;
  vec4 quat = texel(geometry, 4 * row + 1);
  vec3 log_scales = texel(geometry, 4 * row + 2).xyz;
  if (row < MOVING) {
#if NEIGHBOURS > 0
    follow_bodies(row, mean, quat, log_scales);
#endif
#if OWN > 0
    ivec4 ends = ivec4(texel(own_ends, row));
    mean += sum_of_curves(row > 0 ? int(texel(own_ends, row - 1).w) : 0, ends.x).xyz;
    quat += sum_of_curves(ends.x, ends.y);
    log_scales += sum_of_curves(ends.y, ends.z).xyz;
    opacity = clamp(opacity + sum_of_curves(ends.z, ends.w).x, 0.0, 1.0);
#endif
#if LIVES
    opacity *= life(row);
#endif
  }
  centre = longer = shorter = vec2(0.0);
  colour = vec4(0.0);
  vec3 seen = (world_to_camera * vec4(mean, 1.0)).xyz;
  depth = seen.z;
  if (!(seen.z > NEAR) || !(opacity >= ALPHA_MIN)) return;
  quat /= max(length(quat), 1e-12);
  mat3 axes = rotation(quat);
  vec3 scales = exp(log_scales);
  vec3 shape = project(seen, mat3(axes[0] * scales.x, axes[1] * scales.y, axes[2] * scales.z));
  float det = shape.x * shape.z - shape.y * shape.y;
  if (!(det > 0.0) || det > 1e38) return;
  // The axes of the ellipse where alpha is ALPHA_MIN: eigenvectors of the covariance.
  float half_gap = 0.5 * (shape.x - shape.z);
  float radius = length(vec2(half_gap, shape.y));
  float most = 0.5 * (shape.x + shape.z) + radius;
  vec2 way = half_gap > 0.0 ? vec2(half_gap + radius, shape.y) : vec2(shape.y, radius - half_gap);
  way = radius > 1e-6 * most ? normalize(way) : vec2(1.0, 0.0);
  float reach = sqrt(2.0 * log(opacity / ALPHA_MIN));
  centre = focal * seen.xy / seen.z + middle;
  longer = reach * sqrt(most) * way;
  shorter = reach * sqrt(det / most) * vec2(-way.y, way.x);
  colour = vec4(colour_towards(row, normalize(mean - eye)), opacity);
}`;

export const noFragments = `${head()}
void main() {}`;

/** Draws the rectangle about the ellipse of a splat; the first row of the target is the top one. */
export const cornerShader = `${head()}
layout(location = 0) in vec2 centre;
layout(location = 1) in vec2 longer;
layout(location = 2) in vec2 shorter;
layout(location = 3) in vec4 colour;
layout(location = 4) in float depth;
uniform vec2 size;
uniform float depth_unit; // 0 draws colours, else depths in this unit
out vec2 spot;
flat out vec4 shown;

void main() {
  vec2 side = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  vec2 at = centre + side.x * longer + side.y * shorter;
  gl_Position = colour.a > 0.0 ? vec4(2.0 * at / size - 1.0, 0.0, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
  spot = sqrt(2.0 * log(max(colour.a, ALPHA_MIN) / ALPHA_MIN)) * side;
  shown = depth_unit > 0.0 ? vec4(vec3(depth / depth_unit), colour.a) : colour;
}`;

export const spotShader = `${head()}
in vec2 spot;
flat in vec4 shown;
out vec4 blended;

void main() {
  float alpha = min(shown.a * exp(-0.5 * dot(spot, spot)), ALPHA_MAX);
  if (alpha < ALPHA_MIN) discard;
  blended = vec4(shown.rgb * alpha, alpha);
}`;

export const wholeShader = `${head()}
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

export const backgroundShader = `${head()}
uniform sampler2D target;
uniform vec3 background;
out vec4 shown;

void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec4 drawn = texelFetch(target, ivec2(at.x, textureSize(target, 0).y - 1 - at.y), 0);
  shown = vec4(drawn.rgb + (1.0 - drawn.a) * background, 1.0);
}`;
