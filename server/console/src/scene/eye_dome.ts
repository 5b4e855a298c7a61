/** Eye-dome lighting: pixels that lie farther than the surface around them are darkened, so that shape is seen without colour.
 *
 *     voxels  -->  colour and depth of a picture of their own  -->  shaded, with depth, on the screen  -->  overlays over it
 *
 * After Boucheny (2009), with one change: of two pixels across from each other the mean is taken, not each by itself. The
 * depth of a picture is linear on a plane, so a flat wall stays as bright as it is, however one looks at it.
 *
 * While the eye moves on a machine without a graphics card, the light of one pixel counts for four: what is shaded comes
 * from a picture of half the width and height, which costs a fraction of a whole one. */

import {
  DepthTexture, GLSL3, Mesh, NearestFilter, OrthographicCamera, PlaneGeometry, RawShaderMaterial, RedFormat, Scene, UnsignedIntType, Vector2,
  WebGLRenderTarget, type IUniform, type PerspectiveCamera, type WebGLRenderer,
} from "three";

const VERTEX = "in vec3 position; void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }";

/** Light of a pixel, of its depth and its colour's alpha. */
const LIGHT = `
precision highp float;
precision highp sampler2D;
uniform sampler2D uColour, uDepth;
uniform vec2 uNearFar;
uniform ivec2 uLast;
uniform float uStrength;
const float MOST = 0.02, DARKEST = 0.3;

float at(ivec2 place) {
  float depth = texelFetch(uDepth, clamp(place, ivec2(0), uLast), 0).r;
  return depth >= 1.0 ? -1.0 : depth; // where nothing is drawn nothing is nearer
}

/** How much nearer the plane through two pixels across from each other lies, in depth, beyond what is unsure. */
float hollow(ivec2 here, float depth, ivec2 step, float unsure, float most) {
  float a = at(here + step), b = at(here - step);
  return clamp(depth - 0.5 * ((a < 0.0 ? depth : a) + (b < 0.0 ? depth : b)) - unsure, 0.0, most);
}

float light(ivec2 here, float depth, float alpha) {
  float span = uNearFar.y - uNearFar.x;
  float perDepth = span / (uNearFar.y - depth * span); // parts of the distance
  float most = MOST / perDepth;
  // A step of 24 bits; and flat squares for nodes make stairs of a plane, of an edge that their alpha tells.
  float grain = alpha == 0.0 ? 0.0 : exp2(alpha * 12.0 - 8.0);
  float unsure = 2e-7 + 0.5 * grain * span / (perDepth * perDepth * uNearFar.x * uNearFar.y);
  float sum = hollow(here, depth, ivec2(1, 0), unsure, most) + hollow(here, depth, ivec2(0, 1), unsure, most)
    + hollow(here, depth, ivec2(1, 1), unsure, most) + hollow(here, depth, ivec2(1, -1), unsure, most);
  return max(exp(-sum * perDepth * uStrength), DARKEST);
}`;

/** How the picture is shaded: as it is, pixel by pixel, or by the light of one in four. */
const PLAIN = 0, WHOLE = 1, QUARTER = 2;

const SCREEN = `${LIGHT}
uniform sampler2D uLight;
uniform int uShading;
out vec4 outColour;
void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  float depth = texelFetch(uDepth, here, 0).r;
  if (depth >= 1.0) discard;
  vec4 colour = texelFetch(uColour, here, 0);
  outColour = vec4(colour.rgb, 1.0);
  gl_FragDepth = depth;
  if (uShading == ${WHOLE}) outColour.rgb *= light(here, depth, colour.a);
  else if (uShading == ${QUARTER}) outColour.rgb *= texelFetch(uLight, here >> 1, 0).r;
}`;

/** Picture of the light alone, with one pixel for four. */
const LIGHTS = `${LIGHT}
out vec4 outLight;
void main() {
  ivec2 here = min(ivec2(gl_FragCoord.xy) << 1, uLast);
  float depth = texelFetch(uDepth, here, 0).r;
  outLight = vec4(depth >= 1.0 ? 1.0 : light(here, depth, texelFetch(uColour, here, 0).a));
}`;

/** Shading per part of the distance; of a step of 4 cm at 5 m some half of the light is left. */
const STRENGTH = 60;

export class EyeDome {
  private readonly target = new WebGLRenderTarget(1, 1, {
    magFilter: NearestFilter, minFilter: NearestFilter, depthTexture: new DepthTexture(1, 1, UnsignedIntType),
  });
  private readonly lights = new WebGLRenderTarget(1, 1, { magFilter: NearestFilter, minFilter: NearestFilter, format: RedFormat, depthBuffer: false });
  private readonly flat = new OrthographicCamera(-1, 1, 1, -1, 0, 1);
  private readonly uniforms = {
    uColour: { value: this.target.texture }, uDepth: { value: this.target.depthTexture }, uNearFar: { value: new Vector2() }, uLast: { value: new Vector2() },
    uStrength: { value: STRENGTH }, uLight: { value: this.lights.texture }, uShading: { value: WHOLE },
  } satisfies Record<string, IUniform>;
  private readonly screen = new FlatPass(SCREEN, this.uniforms);
  private readonly light = new FlatPass(LIGHTS, this.uniforms);

  /** 0: none; 1: as it is made for. */
  strength = 1;

  /** Have the shaders compiled for the pictures in which they are used. */
  async compile(renderer: WebGLRenderer, voxels: Scene, camera: PerspectiveCamera): Promise<void> {
    const canWait = renderer.getContext().getExtension("KHR_parallel_shader_compile");
    const compiled = (target: WebGLRenderTarget | null, scene: Scene, eye: PerspectiveCamera | OrthographicCamera) => {
      renderer.setRenderTarget(target);
      const done = canWait ? renderer.compileAsync(scene, eye) : renderer.compile(scene, eye);
      renderer.setRenderTarget(null);
      return done;
    };
    await Promise.all([compiled(this.target, voxels, camera), compiled(this.lights, this.light.scene, this.flat), compiled(null, this.screen.scene, this.flat)]);
  }

  /** Draw the voxels, shaded, and then what lies over them as it is; `isCoarse`: the light of one pixel counts for four. */
  render(renderer: WebGLRenderer, voxels: Scene, overlays: Scene, camera: PerspectiveCamera, isCoarse: boolean): void {
    const { width, height } = renderer.domElement;
    if (this.target.width !== width || this.target.height !== height) {
      this.target.setSize(width, height);
      this.lights.setSize(Math.ceil(width / 2), Math.ceil(height / 2));
    }
    const { uNearFar, uLast, uStrength, uShading } = this.uniforms;
    uNearFar.value.set(camera.near, camera.far);
    uLast.value.set(width - 1, height - 1);
    uStrength.value = STRENGTH * this.strength;
    uShading.value = this.strength === 0 ? PLAIN : isCoarse ? QUARTER : WHOLE;
    renderer.setRenderTarget(this.target);
    renderer.clear();
    renderer.render(voxels, camera);
    if (uShading.value === QUARTER) {
      renderer.setRenderTarget(this.lights);
      renderer.render(this.light.scene, this.flat);
    }
    renderer.setRenderTarget(null);
    renderer.render(this.screen.scene, this.flat);
    renderer.autoClear = false;
    renderer.render(overlays, camera);
    renderer.autoClear = true;
  }

  dispose(): void {
    this.target.depthTexture?.dispose();
    this.target.dispose();
    this.lights.dispose();
    this.screen.dispose();
    this.light.dispose();
  }
}

/** A shader over a whole picture. */
class FlatPass {
  readonly scene = new Scene();
  private readonly material: RawShaderMaterial;

  constructor(fragmentShader: string, uniforms: Record<string, IUniform>) {
    this.material = new RawShaderMaterial({ glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader, uniforms });
    const mesh = new Mesh(new PlaneGeometry(2, 2), this.material);
    mesh.frustumCulled = false;
    this.scene.add(mesh);
  }

  dispose(): void {
    this.material.dispose();
  }
}
