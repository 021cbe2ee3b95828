// Projection of one Gaussian; constants as in dg4d_lib/rasterizer/interface.py.
precision highp float;
precision highp int;

const int PER_LINE = 1024;
const float BLUR = 0.3;
const float MIN_ALPHA = 1.0 / 255.0;
const float MAX_SIGMA = 3.33;
const float NEAR = 0.2;
const float FRUSTUM_MARGIN = 1.3;

uniform mat4 modelViewMatrix;
uniform mat4 projectionMatrix;
uniform vec2 size; // of the picture, pixels
uniform highp sampler2D motion;
uniform sampler2D paint;

in vec3 position; // a corner of the square, -1 or 1
in uint order;

out vec2 place; // in standard deviations
out vec4 tint; // color, opacity

mat3 rotation(vec4 q) {
  q = normalize(q);
  vec3 s = 2.0 * q.xyz;
  vec3 d = q.xyz * s;
  float xy = q.x * s.y, xz = q.x * s.z, yz = q.y * s.z;
  vec3 w = q.w * s;
  return mat3(1.0 - d.y - d.z, xy + w.z, xz - w.y, xy - w.z, 1.0 - d.x - d.z, yz + w.x, xz + w.y, yz - w.x, 1.0 - d.x - d.y);
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside: not drawn
  int i = int(order);
  ivec2 at = ivec2(i % PER_LINE, i / PER_LINE);
  tint = texelFetch(paint, at, 0);
  at.x *= 3;
  vec3 center = (modelViewMatrix * vec4(texelFetch(motion, at, 0).xyz, 1.0)).xyz;
  float depth = -center.z;
  if (depth < NEAR || tint.a <= MIN_ALPHA) return;

  vec2 focal = 0.5 * size * vec2(projectionMatrix[0][0], projectionMatrix[1][1]);
  vec2 limit = FRUSTUM_MARGIN * 0.5 * size / focal;
  vec2 slope = clamp(center.xy / depth, -limit, limit);
  mat3 spread = mat3(modelViewMatrix) * rotation(texelFetch(motion, at + ivec2(1, 0), 0));
  vec3 scales = exp(texelFetch(motion, at + ivec2(2, 0), 0).xyz);
  float a = BLUR, b = 0.0, c = BLUR;
  for (int k = 0; k < 3; k++) {
    vec3 axis = spread[k] * scales[k];
    vec2 shadow = focal / depth * (axis.xy + slope * axis.z);
    a += shadow.x * shadow.x;
    b += shadow.x * shadow.y;
    c += shadow.y * shadow.y;
  }

  float middle = 0.5 * (a + c);
  float radius = length(vec2(0.5 * (a - c), b));
  vec2 lengths = sqrt(vec2(middle + radius, max(middle - radius, 0.5 * BLUR)));
  vec2 along = a >= c ? vec2(0.5 * (a - c) + radius, b) : vec2(b, 0.5 * (c - a) + radius); // of the longer axis
  along = radius > 1e-6 * middle ? normalize(along) : vec2(1.0, 0.0);
  float reach = min(MAX_SIGMA, sqrt(2.0 * log(tint.a / MIN_ALPHA)));
  place = reach * position.xy;
  vec2 offset = place.x * lengths.x * along + place.y * lengths.y * vec2(-along.y, along.x);
  vec4 projected = projectionMatrix * vec4(center, 1.0);
  gl_Position = vec4(projected.xy / projected.w + 2.0 * offset / size, 0.0, 1.0);
}
