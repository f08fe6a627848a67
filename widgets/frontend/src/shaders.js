// Our own shading: colours are numbers here, so nothing but light may change them.  Colours are as a screen shows them.

const LIGHT = `
vec3 lit(vec3 colour, vec3 normal, float flatness) {
  // three lights that stand still in the frame of view: key, fill, rim (as in widgets/picture.py)
  float key = max(dot(normal, normalize(vec3(-1.2, 2.4, 2.0))), 0.0);
  float fill = max(dot(normal, normalize(vec3(2.2, 0.6, 1.5))), 0.0);
  float front = max(normal.z, 0.0);
  vec3 light = 0.34 + 0.42 * key * vec3(1.0, 0.97, 0.93) + 0.16 * fill * vec3(0.93, 0.96, 1.0) + 0.22 * front;
  return colour * mix(light, vec3(0.62 + 0.42 * front), flatness);
}`;

const COLOUR = `
uniform sampler2D map; uniform vec2 limits; uniform float steps; uniform vec3 plain; uniform int painted;
vec3 colourOf(float value) {
  if (painted == 0) return plain;
  if (value < -1e29) return vec3(0.73);            // NaN
  float place = clamp((value - limits.x) / max(limits.y - limits.x, 1e-12), 0.0, 1.0);
  return texture(map, vec2((floor(place * (steps - 1e-3)) + 0.5) / steps, 0.5)).rgb;
}`;

export const meshVertex = `
precision highp float; precision highp int;
uniform mat4 modelViewMatrix, projectionMatrix; uniform mat3 normalMatrix;
uniform float isolated;                            // -1: all regions
${COLOUR}
in vec3 position, normal; in float value, state, region;
out vec3 vNormal, vColour; out float vMark, vHidden, vFaint; out vec3 vPlace;
void main() {
  vec4 place = modelViewMatrix * vec4(position, 1.0);
  vPlace = place.xyz;
  vNormal = normalMatrix * normal;
  vColour = colourOf(value);
  vMark = state == 1.0 && painted == 0 ? 1.0 : 0.0; // painted numbers stay to be read; the dots tell the marks
  vHidden = state == 2.0 ? 1.0 : 0.0;              // NaN
  vFaint = isolated >= 0.0 && region != isolated ? 1.0 : 0.0;
  gl_Position = projectionMatrix * place;
}`;

export const meshFragment = `
precision highp float; precision highp int;
uniform float opacity, flatness; uniform int faceted; uniform vec3 warning;
in vec3 vNormal, vColour; in float vMark, vHidden, vFaint; in vec3 vPlace;
out vec4 pixel;
${LIGHT}
void main() {
  if (vHidden > 0.0) discard;
  vec3 normal = faceted == 1 ? cross(dFdx(vPlace), dFdy(vPlace)) : vNormal;
  normal = normalize(normal);
  if (normal.z < 0.0) normal = -normal;            // both sides of a cloth are seen
  vec3 colour = mix(vColour, warning, smoothstep(0.3, 0.7, vMark));
  if (vFaint > 0.5) {                              // outside of the isolated region: a sieve
    ivec2 spot = ivec2(gl_FragCoord.xy);
    if ((spot.x & 3) != 0 || (spot.y & 3) != 0) discard;
    colour = vec3(0.75);
  }
  pixel = vec4(lit(colour, normal, flatness), opacity);
}`;

export const dotVertex = `
precision highp float; precision highp int;
uniform mat4 modelViewMatrix, projectionMatrix; uniform float size, isolated; uniform int only;
${COLOUR}
in vec3 position; in float value, state, region;
out vec3 vColour;
void main() {
  bool shown = state != 2.0 && (only == 0 || state == 1.0) && !(isolated >= 0.0 && region != isolated);
  vColour = only == 0 ? colourOf(value) : plain;
  gl_Position = shown ? projectionMatrix * modelViewMatrix * vec4(position, 1.0) : vec4(2.0, 2.0, 2.0, 1.0);
  gl_PointSize = size;
}`;

export const dotFragment = `
precision highp float;
in vec3 vColour; out vec4 pixel;
void main() {
  vec2 from = gl_PointCoord * 2.0 - 1.0;
  float away = dot(from, from);
  if (away > 1.0) discard;
  pixel = vec4(vColour * (1.0 - 0.35 * away), 1.0);
}`;

export const surfelVertex = `
precision highp float; precision highp int;
uniform mat4 modelViewMatrix, projectionMatrix; uniform mat3 normalMatrix; uniform float radius;
${COLOUR}
in vec3 position, place, facing; in float value, state;
out vec3 vNormal, vColour; out vec2 vCorner; out float vHidden;
void main() {
  vec3 n = normalize(facing + vec3(0.0, 0.0, 1e-9));
  vec3 across = normalize(cross(n, abs(n.x) < 0.8 ? vec3(1.0, 0.0, 0.0) : vec3(0.0, 1.0, 0.0)));
  vec3 along = cross(n, across);
  vCorner = position.xy;
  vHidden = state == 2.0 ? 1.0 : 0.0;
  vNormal = normalMatrix * n;
  vColour = state == 1.0 ? vec3(0.95, 0.0, 0.45) : colourOf(value);
  gl_Position = projectionMatrix * modelViewMatrix
    * vec4(place + radius * (position.x * across + position.y * along), 1.0);
}`;

export const surfelFragment = `
precision highp float;
in vec3 vNormal, vColour; in vec2 vCorner; in float vHidden; out vec4 pixel;
${LIGHT}
void main() {
  if (vHidden > 0.0 || dot(vCorner, vCorner) > 1.0) discard;
  vec3 normal = normalize(vNormal);
  pixel = vec4(lit(vColour, normal.z < 0.0 ? -normal : normal, 0.0), 1.0);
}`;

export const lineVertex = `
precision highp float;
uniform mat4 modelViewMatrix, projectionMatrix;
in vec3 position;
void main() {
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
  gl_Position.z -= 2e-4 * gl_Position.w;           // in front of the surface it lies on
}`;

export const lineFragment = `
precision highp float;
uniform vec3 plain; out vec4 pixel;
void main() { pixel = vec4(plain, 1.0); }`;
