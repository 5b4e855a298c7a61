/** Eye-dome lighting: pixels that lie farther than the surface around them are darkened, so that shape is seen without colour.
 *
 *     voxels  -->  colour and depth of a picture of their own  -->  shaded, with depth, on the screen  -->  overlays over it
 *
 * After Boucheny (2009), with one change: of two pixels across from each other the mean is taken, not each by itself. The
 * depth of a picture is linear on a plane, so a flat wall stays as bright as it is, however one looks at it. */

import {
  DepthTexture, GLSL3, Mesh, NearestFilter, OrthographicCamera, PlaneGeometry, RawShaderMaterial, Scene, UnsignedIntType, Vector2,
  WebGLRenderTarget, type PerspectiveCamera, type WebGLRenderer,
} from "three";

const VERTEX = "in vec3 position; void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }";

const FRAGMENT = `
precision highp float;
precision highp sampler2D;
uniform sampler2D uColour, uDepth;
uniform vec2 uNearFar;
uniform ivec2 uLast;
uniform float uStrength;
const float MOST = 0.02, DARKEST = 0.3;
out vec4 outColour;

float at(ivec2 place) {
  float depth = texelFetch(uDepth, clamp(place, ivec2(0), uLast), 0).r;
  return depth >= 1.0 ? -1.0 : depth; // where nothing is drawn nothing is nearer
}

/** How much nearer the plane through two pixels across from each other lies, in depth, beyond what is unsure. */
float hollow(ivec2 here, float depth, ivec2 step, float unsure, float most) {
  float a = at(here + step), b = at(here - step);
  return clamp(depth - 0.5 * ((a < 0.0 ? depth : a) + (b < 0.0 ? depth : b)) - unsure, 0.0, most);
}

void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  float depth = texelFetch(uDepth, here, 0).r;
  if (depth >= 1.0) discard;
  vec4 colour = texelFetch(uColour, here, 0);
  outColour = vec4(colour.rgb, 1.0);
  gl_FragDepth = depth;
  if (uStrength == 0.0) return;
  float span = uNearFar.y - uNearFar.x;
  float perDepth = span / (uNearFar.y - depth * span); // parts of the distance
  float most = MOST / perDepth;
  // A step of 24 bits; and flat squares for nodes make stairs of a plane, of an edge that their alpha tells.
  float grain = colour.a == 0.0 ? 0.0 : exp2(colour.a * 12.0 - 8.0);
  float unsure = 2e-7 + 0.5 * grain * span / (perDepth * perDepth * uNearFar.x * uNearFar.y);
  float sum = hollow(here, depth, ivec2(1, 0), unsure, most) + hollow(here, depth, ivec2(0, 1), unsure, most)
    + hollow(here, depth, ivec2(1, 1), unsure, most) + hollow(here, depth, ivec2(1, -1), unsure, most);
  outColour.rgb *= max(exp(-sum * perDepth * uStrength), DARKEST);
}`;

/** Shading per part of the distance; of a step of 4 cm at 5 m some half of the light is left. */
const STRENGTH = 60;

export class EyeDome {
  private readonly target = new WebGLRenderTarget(1, 1, {
    magFilter: NearestFilter, minFilter: NearestFilter, depthTexture: new DepthTexture(1, 1, UnsignedIntType),
  });
  private readonly screen = new Scene();
  private readonly flat = new OrthographicCamera(-1, 1, 1, -1, 0, 1);
  private readonly shading = new RawShaderMaterial({
    glslVersion: GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT,
    uniforms: {
      uColour: { value: this.target.texture }, uDepth: { value: this.target.depthTexture }, uNearFar: { value: new Vector2() }, uLast: { value: new Vector2() },
      uStrength: { value: STRENGTH },
    },
  });

  constructor() {
    const mesh = new Mesh(new PlaneGeometry(2, 2), this.shading);
    mesh.frustumCulled = false;
    this.screen.add(mesh);
  }

  /** 0: none; 1: as it is made for. */
  strength = 1;

  /** Have the shaders compiled for the picture in which they are used. */
  async compile(renderer: WebGLRenderer, voxels: Scene, camera: PerspectiveCamera): Promise<void> {
    const canWait = renderer.getContext().getExtension("KHR_parallel_shader_compile");
    renderer.setRenderTarget(this.target);
    const isVoxels = canWait ? renderer.compileAsync(voxels, camera) : renderer.compile(voxels, camera);
    renderer.setRenderTarget(null);
    const isScreen = canWait ? renderer.compileAsync(this.screen, this.flat) : renderer.compile(this.screen, this.flat);
    await Promise.all([isVoxels, isScreen]);
  }

  /** Draw the voxels, shaded or as they are, and then what lies over them. */
  render(renderer: WebGLRenderer, voxels: Scene, overlays: Scene, camera: PerspectiveCamera, isShaded: boolean): void {
    const { width, height } = renderer.domElement;
    if (this.target.width !== width || this.target.height !== height) this.target.setSize(width, height);
    const { uNearFar, uLast, uStrength } = this.shading.uniforms;
    uNearFar.value.set(camera.near, camera.far);
    uLast.value.set(width - 1, height - 1);
    uStrength.value = isShaded ? STRENGTH * this.strength : 0;
    renderer.setRenderTarget(this.target);
    renderer.clear();
    renderer.render(voxels, camera);
    renderer.setRenderTarget(null);
    renderer.render(this.screen, this.flat);
    renderer.autoClear = false;
    renderer.render(overlays, camera);
    renderer.autoClear = true;
  }

  dispose(): void {
    this.target.depthTexture?.dispose();
    this.target.dispose();
    this.shading.dispose();
  }
}
