precision highp float;

const float MAX_ALPHA = 0.999;
const float MIN_ALPHA = 1.0 / 255.0;

in vec2 place;
in vec4 tint;
out vec4 color;

void main() {
  float alpha = min(MAX_ALPHA, tint.a * exp(-0.5 * dot(place, place)));
  if (alpha < MIN_ALPHA) discard;
  color = vec4(tint.rgb * alpha, alpha);
}
