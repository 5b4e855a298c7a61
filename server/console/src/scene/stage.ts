/** Canvas, camera and light hand: draws when something changed, and never otherwise. */

import { Box3, Color, Frustum, Matrix4, PerspectiveCamera, Scene, Spherical, Vector3, WebGLRenderer, type Object3D } from "three";
import { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
import type { CameraView } from "../look.ts";
import type { Triple } from "../messages.ts";
import { EyeDome } from "./eye_dome.ts";
import { uniforms } from "./materials.ts";

const FLIGHT_MS = 450;
/** Time between frames for cells that come, without a graphics card, ms: a frame takes 50 ms and more of all cores, and cells come sooner without it. */
const SOON_MS = 1000;
/** Time from the eye's last move to its rest, ms. */
const REST_MS = 200;
const STEP_RAD = Math.PI / 30;
/** Part of the picture that is filled by what is looked at. */
const FILLED = 0.92;

/** Whether this browser draws in three dimensions at all. */
export function hasWebGl(): boolean {
  const found = document.createElement("canvas").getContext("webgl2");
  found?.getExtension("WEBGL_lose_context")?.loseContext();
  return found !== null;
}

export class Stage {
  readonly renderer: WebGLRenderer;
  readonly camera = new PerspectiveCamera(55, 1, 0.05, 1000);
  readonly controls: OrbitControls;
  /** Voxels, which are shaded by depth; and what is drawn over them as it is. */
  readonly voxels = new Scene();
  readonly overlays = new Scene();
  readonly dome = new EyeDome();
  readonly isSoftware: boolean;
  readonly gpu: string;
  /** Called before a frame; whether another one follows. */
  onFrame: () => boolean = () => false;
  onMove: () => void = () => {};
  /** Called before the eye is brought somewhere else. */
  onFly: () => void = () => {};
  frames = 0;
  private readonly resizes: ResizeObserver;
  private asked = false;
  private later = 0;
  private atRest = 0;
  /** Time up to which the eye counts as moving, as of performance.now(). */
  private restsMs = 0;
  private ready = false;
  private flight: { from: CameraView; to: CameraView; startMs: number } | null = null;

  constructor(host: HTMLElement) {
    this.renderer = new WebGLRenderer({ antialias: false, powerPreference: "high-performance" });
    // To ask whether a shader is sound waits for its compiler: seconds, without a graphics card.
    this.renderer.debug.checkShaderErrors = false;
    const { canvas } = this;
    canvas.tabIndex = 0;
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", "The map in three dimensions. Arrow keys move, plus and minus zoom; see the key list with ?");
    host.append(canvas);
    const gl = this.renderer.getContext();
    const names = gl.getExtension("WEBGL_debug_renderer_info");
    this.gpu = String(gl.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    this.isSoftware = /swiftshader|llvmpipe|software/i.test(this.gpu);
    uniforms.uPointMax.value = (gl.getParameter(gl.ALIASED_POINT_SIZE_RANGE) as Float32Array)[1];
    this.camera.up.set(0, 0, 1);
    this.camera.position.set(-10, -10, 10);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.zoomToCursor = true;
    this.controls.screenSpacePanning = true;
    this.controls.maxDistance = 500;
    this.controls.minDistance = 0.2;
    this.controls.addEventListener("change", () => this.moves());
    this.controls.addEventListener("start", () => (this.flight = null));
    this.resizes = new ResizeObserver(() => this.resize(host));
    this.resizes.observe(host);
    this.resize(host);
  }

  get canvas(): HTMLCanvasElement {
    return this.renderer.domElement;
  }

  /** Lines and other things over the voxels. */
  add(...objects: Object3D[]): void {
    this.overlays.add(...objects);
  }

  /** Have the shaders of what will be drawn compiled next to the page's own work; then draw. */
  async prepare(): Promise<void> {
    await this.dome.compile(this.renderer, this.voxels, this.camera);
    this.ready = true;
    this.draw();
  }

  /** Ask for a frame; many askings make one. */
  draw(): void {
    if (this.asked || !this.ready) return;
    this.asked = true;
    requestAnimationFrame(() => this.frame());
  }

  /** Ask for a frame soon: cells that come one by one are drawn some at a time, where frames are slow. */
  drawSoon(): void {
    if (!this.isSoftware) return this.draw();
    if (this.later) return;
    this.later = window.setTimeout(() => {
      this.later = 0;
      this.draw();
    }, SOON_MS);
  }

  get heightPx(): number {
    return this.canvas.height;
  }

  get frustum(): Frustum {
    this.camera.updateMatrixWorld();
    const matrix = new Matrix4().multiplyMatrices(this.camera.projectionMatrix, this.camera.matrixWorldInverse);
    return new Frustum().setFromProjectionMatrix(matrix);
  }

  get isFlying(): boolean {
    return this.flight !== null;
  }

  get view(): CameraView {
    return { eye: this.camera.position.toArray() as Triple, target: this.controls.target.toArray() as Triple };
  }

  /** Put the eye somewhere, at once. */
  place({ eye, target }: CameraView): void {
    this.camera.position.set(...eye);
    this.controls.target.set(...target);
    this.controls.update();
    this.moves();
  }

  /** Without a graphics card the picture is shaded finely only once the eye rests: a half of a frame's time. */
  get isMoving(): boolean {
    return this.isSoftware && performance.now() < this.restsMs;
  }

  private drawAtRest(): void {
    window.clearTimeout(this.atRest);
    this.atRest = window.setTimeout(() => this.draw(), Math.max(this.restsMs - performance.now(), 0) + 1);
  }

  private moves(): void {
    this.restsMs = performance.now() + REST_MS;
    this.onMove();
    this.draw();
  }

  /** Bring the eye somewhere, so that people see how they got there. */
  fly(to: CameraView): void {
    this.onFly();
    this.flyOn(to);
  }

  /** Bring the eye somewhere as a part of the flight before: `onFly` does not hear of it, so Back undoes both at once. */
  flyOn(to: CameraView): void {
    if (matchMedia("(prefers-reduced-motion: reduce)").matches || this.isSoftware) return this.place(to);
    this.flight = { from: this.view, to, startMs: performance.now() };
    this.draw();
  }

  /** Look at boxes from a side, as near as all their corners are seen: `direction` from them to the eye. */
  lookAt(boxes: readonly Box3[], direction: Vector3): CameraView {
    const back = direction.clone().normalize();
    const right = new Vector3().crossVectors(this.camera.up, back).normalize();
    const up = new Vector3().crossVectors(back, right);
    const corners = boxes.flatMap(({ min, max }) =>
      Array.from({ length: 8 }, (_, n) => new Vector3(n & 1 ? max.x : min.x, n & 2 ? max.y : min.y, n & 4 ? max.z : min.z)),
    );
    const centre = new Box3().setFromPoints(corners).getCenter(new Vector3());
    const tallness = Math.tan((this.camera.fov * Math.PI) / 360) * FILLED;
    let distance = 1;
    // What is nearer looms larger: a few steps bring the middle of the picture to the middle of what is seen.
    for (let step = 0; step < 4; step++) {
      const places = corners.map((corner) => corner.clone().sub(centre));
      const across = places.map((place) => place.dot(right));
      const above = places.map((place) => place.dot(up));
      const nearness = places.map((place) => place.dot(back));
      distance = places.reduce(
        (far, _, n) => Math.max(far, Math.max(Math.abs(across[n]) / this.camera.aspect, Math.abs(above[n])) / tallness + nearness[n]), 1,
      );
      const middle = (values: number[]) => {
        const seen = values.map((value, n) => value / Math.max(distance - nearness[n], 0.1));
        return ((Math.min(...seen) + Math.max(...seen)) / 2) * distance;
      };
      if (step < 3) centre.addScaledVector(right, middle(across)).addScaledVector(up, middle(above));
    }
    return { eye: centre.clone().addScaledVector(back, distance).toArray() as Triple, target: centre.toArray() as Triple };
  }

  /** Go round what is looked at, in steps of 6 degrees. */
  turn(right: number, down: number): void {
    const around = this.camera.position.clone().sub(this.controls.target);
    const sphere = new Spherical().setFromCartesianCoords(around.x, around.z, -around.y);
    sphere.theta += right * STEP_RAD;
    sphere.phi = Math.min(Math.max(sphere.phi + down * STEP_RAD, 0.01), Math.PI - 0.01);
    const turned = new Vector3().setFromSpherical(sphere);
    const eye = this.controls.target.clone().add(new Vector3(turned.x, -turned.z, turned.y));
    this.place({ eye: eye.toArray() as Triple, target: this.view.target });
  }

  nearer(factor: number): void {
    const eye = this.camera.position.clone().sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.place({ eye: eye.toArray() as Triple, target: this.view.target });
  }

  setBackground(colour: string): void {
    this.renderer.setClearColor(new Color(colour));
    this.draw();
  }

  /** Let go of the graphics card: browsers keep few pictures of this kind. */
  dispose(): void {
    window.clearTimeout(this.later);
    window.clearTimeout(this.atRest);
    this.ready = false;
    this.resizes.disconnect();
    this.controls.dispose();
    this.dome.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }

  private frame(): void {
    this.asked = false;
    if (!this.ready) return;
    this.stepFlight();
    const again = this.onFrame();
    const { width, height } = this.canvas;
    uniforms.uViewport.value.set(0, 0, width, height);
    uniforms.uNearFar.value.set(this.camera.near, this.camera.far);
    this.dome.render(this.renderer, this.voxels, this.overlays, this.camera, this.isMoving);
    if (this.isMoving) this.drawAtRest();
    this.frames++;
    if (again || this.flight) this.draw();
  }

  private stepFlight(): void {
    if (!this.flight) return;
    const { from, to, startMs } = this.flight;
    const x = Math.min((performance.now() - startMs) / FLIGHT_MS, 1);
    const ease = x * x * (3 - 2 * x);
    const between = (a: Triple, b: Triple) => a.map((value, n) => value + (b[n] - value) * ease) as Triple;
    if (x >= 1) this.flight = null;
    this.place({ eye: between(from.eye, to.eye), target: between(from.target, to.target) });
  }

  private resize(host: HTMLElement): void {
    const { clientWidth, clientHeight } = host;
    if (!clientWidth || !clientHeight) return;
    // More pixels than points take time without telling more.
    this.renderer.setPixelRatio(this.isSoftware ? 1 : Math.min(devicePixelRatio, 2));
    this.renderer.setSize(clientWidth, clientHeight);
    this.camera.aspect = clientWidth / clientHeight;
    this.camera.updateProjectionMatrix();
    this.onMove();
    this.draw();
  }
}
