/** Voxels as points: one vertex a voxel, 12 bytes; how they look is uniforms, so nothing is sent or made again.
 *
 * Three materials share one vertex shader: squares (cheapest), boxes (the ray of each pixel is cut with the voxel's
 * cube, so edges, faces and depth are exact), and boxes that say which voxel they are instead of a colour. */

import { DataTexture, DoubleSide, GLSL3, ShaderMaterial, Vector2, Vector3, Vector4, type IUniform } from "three";
import { DIFFICULTY_STEP, HEAT_STEP_K, HEAT_ZERO_K, RISE_STEP_M, SLOPE_STEP_DEG } from "../decode/pack.ts";
import { OVER, rgbOf, textureOf, UNDER } from "../palettes.ts";

export const FIELD_CODES = { colour: 0, temperature: 1, probability: 2, height: 3, age: 4, robot: 5, difficulty: 6, slope: 7, step: 8 } as const;
/** A box spreads over at most this much of its edge in a picture: the diagonal, and some for perspective. */
const SPREAD = 1.9;

export const uniforms = {
  uField: { value: 0 },
  uRange: { value: new Vector2(0, 1) },
  /** Above and below the range. */
  uOver: { value: new Vector3(...rgbOf(OVER)) },
  uUnder: { value: new Vector3(...rgbOf(UNDER)) },
  uPalette: { value: textureOf("inferno") as DataTexture },
  uLow: { value: new Vector3(-1e9, -1e9, -1e9) },
  uHigh: { value: new Vector3(1e9, 1e9, 1e9) },
  uMinP: { value: 0 },
  /** Kelvin; low above high: no band. */
  uBand: { value: new Vector2(1, 0) },
  uViewport: { value: new Vector4(0, 0, 1, 1) },
  uNearFar: { value: new Vector2(0.05, 1000) },
  uPointMax: { value: 64 },
  uBare: { value: new Vector3(0.45, 0.47, 0.5) },
  /** What is not in the band that stands out. */
  uFaded: { value: new Vector3(0.2, 0.21, 0.22) },
  /** Of the object that is drawn: its age from 0 to 1, how freshly it changed, its number. */
  uAge: { value: 0 },
  uFresh: { value: 0 },
  /** Colour of the robot that changed it last; negative: nobody knows. */
  uRobot: { value: new Vector3(-1, -1, -1) },
  uObject: { value: 0 },
  /** Thickness of a level's surfaces, m; 0: the map is none. */
  uLevelM: { value: 0 },
} satisfies Record<string, IUniform>;

const VERTEX = `
in vec4 place;    // x, y, z in nodes, probability in 1/255
in vec4 colour;   // red, green, blue; flags in 1/255
in vec4 heat;     // mean and hottest, in steps, two bytes each
uniform int uField;
uniform vec2 uRange, uBand;
uniform vec3 uLow, uHigh, uBare, uFaded, uRobot, uOver, uUnder;
uniform float uMinP, uPointMax, uAge, uFresh, uLevelM;
uniform vec4 uViewport;
uniform sampler2D uPalette;
flat out vec3 vColour;
flat out float vBare;
flat out vec3 vCentre;   // from the eye, along the map's axes
flat out vec3 vHalf;
flat out vec4 vLens;
flat out uint vVertex;
flat out float vLight;
const float GROWN = __GROWN__;

// Beyond the ends of the palette the colours of the legend's end blocks; what the ends' rounding leaves over is within.
vec3 shade(float x) {
  if (x > 1.004) return uOver;
  if (x < -0.004) return uUnder;
  return texture(uPalette, vec2((clamp(x, 0.0, 1.0) * 255.0 + 0.5) / 256.0, 0.5)).rgb;
}

void main() {
  vec4 world = modelMatrix * vec4(place.xyz + 0.5, 1.0);
  float edge = modelMatrix[0].x;
  vHalf = vec3(edge, edge, modelMatrix[2].z) * 0.5;
  float millimetres = heat.x + 256.0 * heat.y;
  float top = world.z + vHalf.z;
  // A surface of a level lies at its own height, and reaches down to the lowest one around it.
  if (uLevelM > 0.0 && millimetres > 0.0) {
    top = world.z - vHalf.z + (millimetres - 1.0) * 0.001;
    vHalf.z = 0.5 * (uLevelM + (heat.z + 256.0 * heat.w) * 0.001);
    world.z = top - vHalf.z;
  }
  float p = place.w / 255.0;
  int flags = int(colour.a * 255.0 + 0.5);
  bool coloured = (flags & 1) != 0;
  bool warm = (flags & 2) != 0;
  vec4 seen = viewMatrix * world;
  gl_Position = projectionMatrix * seen;
  bool hidden = p < uMinP || any(lessThan(world.xyz, uLow)) || any(greaterThan(world.xyz, uHigh)) || seen.z > -edge * 0.5;
  if (hidden) gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
  vLens = vec4(projectionMatrix[0][0], projectionMatrix[1][1], projectionMatrix[2][0], projectionMatrix[2][1]);
  gl_PointSize = min(max(edge, 1.2 * vHalf.z) * GROWN * vLens.y * uViewport.w * 0.5 / max(-seen.z, edge * 0.6) + 1.0, uPointMax);
  vCentre = world.xyz - cameraPosition;
  vVertex = uint(gl_VertexID);
  // Lit by those of its open faces that the eye can see, the more the straighter; by all others if there is none.
  vec3 eye = normalize(-vCentre);
  vec3 low = vec3(flags & 4, (flags >> 2) & 4, (flags >> 4) & 4) * 0.25 * max(-eye, 0.0);
  vec3 high = vec3(flags & 8, (flags >> 2) & 8, (flags >> 4) & 8) * 0.125 * max(eye, 0.0);
  vec3 open = low + high;
  float sum = open.x + open.y + open.z;
  vec3 lit = vec3(0.88, 0.74, 0.0) * open;
  vLight = sum < 0.02 ? 0.8 : (lit.x + lit.y + high.z * 1.04 + low.z * 0.62) / sum;
  float kelvin = (heat.x + 256.0 * heat.y) * ${HEAT_STEP_K.toFixed(3)} + ${HEAT_ZERO_K.toFixed(1)};
  float hottest = (heat.z + 256.0 * heat.w) * ${HEAT_STEP_K.toFixed(3)} + ${HEAT_ZERO_K.toFixed(1)};
  vBare = 0.0;
  float span = max(uRange.y - uRange.x, 1e-6);
  if (uField == 0) {
    vColour = coloured ? colour.rgb : uBare;
    vBare = coloured ? 0.0 : 1.0;
  } else if (uField == 1) {
    vColour = warm ? shade((hottest - uRange.x) / span) : uBare;
    vBare = warm ? 0.0 : 1.0;
  } else if (uField == 2) vColour = shade((p - uRange.x) / span);
  else if (uField == 3) vColour = shade(((uLevelM > 0.0 ? top : world.z) - uRange.x) / span);
  else if (uField >= 6) {
    // Codes of scene/ground.ts.
    float value = uField == 6 ? colour.r * ${(255 * DIFFICULTY_STEP).toFixed(2)} : uField == 7 ? colour.g * ${(255 * SLOPE_STEP_DEG).toFixed(2)} : colour.b * ${(255 * RISE_STEP_M).toFixed(2)};
    bool known = coloured && (uField != 7 || colour.g < 0.998);
    vColour = known ? shade((value - uRange.x) / span) : uBare;
    vBare = known ? 0.0 : 1.0;
  } else if (uField == 5) {
    vColour = uRobot.x < 0.0 ? uBare : uRobot * (0.45 + 0.55 * p);
    vBare = uRobot.x < 0.0 ? 1.0 : 0.0;
  } else vColour = shade(1.0 - (uAge - uRange.x) / span);
  if (vColour == uOver || vColour == uUnder) vBare = 1.0; // flat, as the legend's blocks are
  if (uBand.x <= uBand.y && !(warm && hottest >= uBand.x && kelvin <= uBand.y)) {
    vColour = mix(uFaded, vColour, 0.12);
    vBare = 0.0;
  }
  vColour = mix(vColour, vec3(1.0, 1.0, 0.85), uFresh);
}`;

const FRAGMENT_HEAD = `
precision highp float;
precision highp int;
flat in vec3 vColour;
flat in float vBare;
flat in vec3 vCentre;
flat in vec3 vHalf;
flat in vec4 vLens;
flat in uint vVertex;
flat in float vLight;
uniform vec4 uViewport;
uniform vec2 uNearFar;
uniform uint uObject;
// What has no value of the field is lit less by its faces: flat, so that it does not speak before what has one.
const float QUIET = 0.5;
`;

const SQUARE = `${FRAGMENT_HEAD}
out vec4 outColour;
void main() {
  // Alpha tells the edge of the square to the shading by depth: scene/eye_dome.ts.
  outColour = vec4(vColour * mix(vLight, 0.9, vBare * QUIET), (log2(2.0 * vHalf.x) + 8.0) / 12.0);
}`;

/** Where the pixel's ray meets the cube; `t` is the depth along the view's axis. */
const CUT = `
  vec2 at = (gl_FragCoord.xy - uViewport.xy) / uViewport.zw * 2.0 - 1.0;
  vec3 ray = transpose(mat3(viewMatrix)) * vec3((at + vLens.zw) / vLens.xy, -1.0);
  vec3 a = (vCentre - vHalf) / ray, b = (vCentre + vHalf) / ray;
  vec3 enter = min(a, b), leave = max(a, b);
  float t = max(max(enter.x, enter.y), enter.z);
  if (t > min(min(leave.x, leave.y), leave.z) || t <= 0.0) discard;
  float far = uNearFar.y, near = uNearFar.x;
  gl_FragDepth = clamp(0.5 + 0.5 * ((far + near) - 2.0 * far * near / t) / (far - near), 0.0, 1.0);
`;

const BOX = `${FRAGMENT_HEAD}
out vec4 outColour;
void main() {
  ${CUT}
  vec3 lit = vec3(t == enter.x, t == enter.y, t == enter.z);
  float light = dot(lit, vec3(0.88, 0.74, ray.z < 0.0 ? 1.04 : 0.62)) / max(lit.x + lit.y + lit.z, 1.0);
  outColour = vec4(vColour * mix(light, 0.9, vBare * QUIET), 0.0);
}`;

const NUMBER = `${FRAGMENT_HEAD}
out uvec4 outNumber;
void main() {
  ${CUT}
  outNumber = uvec4(uObject + 1u, vVertex, floatBitsToUint(t), 1u);
}`;

function material(fragmentShader: string, grown: number): ShaderMaterial {
  const vertexShader = VERTEX.replace("__GROWN__", grown.toFixed(2));
  const made = new ShaderMaterial({ uniforms, vertexShader, fragmentShader, glslVersion: GLSL3, side: DoubleSide });
  made.toneMapped = false;
  return made;
}

export const squares = material(SQUARE, 1.25);
export const boxes = material(BOX, SPREAD);
export const numbers = material(NUMBER, SPREAD);
