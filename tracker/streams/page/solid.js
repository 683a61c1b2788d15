// The 3-D view: the tongue as tissue, coils with their names, residual sticks, palate, ghost.

import {
  BufferAttribute, BufferGeometry, CatmullRomCurve3, Color, DirectionalLight, DoubleSide, DynamicDrawUsage, Group,
  HemisphereLight, LineBasicMaterial, LineSegments, Mesh, MeshPhysicalMaterial, MeshStandardMaterial,
  OrbitControls, PerspectiveCamera, Scene, SphereGeometry, TubeGeometry, Vector3, WebGLRenderer,
} from "./three.bundle.js";
import { toScene } from "./tongue.js";

const COIL_RADIUS_M = 0.0017;
const FROM = new Vector3(0.8, 0.42, 0.62); // the speaker's left front, a little above: the tip points to the left

/** Draws the tongue of a model.glb, or the vertices that a pose brings along. */
class Body {
  constructor(material) {
    this.material = material;
    this.group = new Group();
    this.tongue = null;
    this.morphed = this.streamed = null;
  }

  take(tongue) {
    this.group.clear();
    this.streamed = null;
    this.tongue = tongue;
    this.morphed = new Mesh(tongue.mesh.geometry, this.material);
    this.morphed.frustumCulled = false;
    this.group.add(this.morphed);
  }

  show(pose) {
    if (!this.tongue) return;
    const streamed = pose.vertices !== null;
    this.morphed.visible = !streamed;
    if (this.streamed) this.streamed.visible = streamed;
    if (streamed) this.stream(pose.vertices);
    else this.tongue.unit(pose.weights).forEach((weight, k) => (this.morphed.morphTargetInfluences[k] = weight));
  }

  stream(vertices) {
    if (!this.streamed) {
      const geometry = new BufferGeometry();
      geometry.setIndex(this.tongue.mesh.geometry.index);
      geometry.setAttribute("position", new BufferAttribute(new Float32Array(vertices.length), 3).setUsage(DynamicDrawUsage));
      this.streamed = new Mesh(geometry, this.material);
      this.streamed.frustumCulled = false;
      this.group.add(this.streamed);
    }
    const position = this.streamed.geometry.attributes.position;
    for (let v = 0; v < position.count; v += 1) {
      position.setXYZ(v, ...toScene(vertices[3 * v], vertices[3 * v + 1], vertices[3 * v + 2]));
    }
    position.needsUpdate = true;
    this.streamed.geometry.computeVertexNormals();
  }
}

/** Whether two poses give the same picture. */
function looksLike(one, other) {
  const same = (name) => one[name].every((value, i) => Object.is(value, other[name][i]));
  return !one.vertices && !other.vertices && same("weights") && same("coils") && same("states");
}

export class Solid {
  /** place: the element to fill; throws where the browser has no WebGL. */
  constructor(place) {
    this.place = place;
    this.renderer = new WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.canvas = this.renderer.domElement;
    place.append(this.canvas);
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(28, 1, 0.01, 3);
    this.camera.position.copy(FROM);
    this.key = new DirectionalLight(0xfff3ea, 2.0);
    this.key.position.set(0.5, 1.2, 0.9);
    this.fill = new DirectionalLight(0xc9dcff, 0.9);
    this.fill.position.set(-0.9, 0.2, -0.4);
    this.scene.add(new HemisphereLight(0xffffff, 0x8a6663, 1.5), this.key, this.fill);
    this.tissue = new MeshPhysicalMaterial({
      roughness: 0.52, clearcoat: 0.22, clearcoatRoughness: 0.42, sheen: 0.55, sheenRoughness: 0.6,
      specularIntensity: 0.55, side: DoubleSide,
    });
    this.veil = new MeshStandardMaterial({ transparent: true, opacity: 0.26, roughness: 0.9, depthWrite: false });
    this.bone = new MeshStandardMaterial({ roughness: 0.8 });
    this.stick = new LineBasicMaterial();
    this.body = new Body(this.tissue);
    this.shadow = new Body(this.veil);
    this.shadow.group.visible = false;
    this.shadow.group.renderOrder = 1;
    this.extras = new Group();
    this.scene.add(this.body.group, this.shadow.group, this.extras);
    this.controls = new OrbitControls(this.camera, this.canvas);
    this.controls.enableDamping = false;
    this.controls.minDistance = 0.05;
    this.controls.maxDistance = 0.8;
    this.controls.addEventListener("change", () => (this.stale = true));
    this.canvas.addEventListener("dblclick", () => this.reset());
    new ResizeObserver(() => this.resize()).observe(place);
    this.centre = new Vector3();
    this.reach = 0.05;
    this.stale = true;
  }

  /** Coils, their names and the palate of a run. */
  prepare(hello, names, colours) {
    this.hello = hello;
    this.last = null;
    this.extras.clear();
    this.place.querySelectorAll(".name").forEach((label) => label.remove());
    const ball = new SphereGeometry(COIL_RADIUS_M, 20, 14);
    this.coils = hello.coils.map((_, i) => {
      const mesh = new Mesh(ball, new MeshStandardMaterial({ color: colours[i], roughness: 0.35 }));
      const label = document.createElement("span");
      label.className = "name";
      label.textContent = names[i];
      this.place.append(label);
      mesh.visible = false;
      this.extras.add(mesh);
      return { mesh, label };
    });
    const sticks = new BufferGeometry();
    sticks.setAttribute("position", new BufferAttribute(new Float32Array(6 * hello.coils.length), 3).setUsage(DynamicDrawUsage));
    this.sticks = new LineSegments(sticks, this.stick);
    this.sticks.frustumCulled = false;
    this.extras.add(this.sticks);
    if (hello.palate) {
      const curve = new CatmullRomCurve3(hello.palate.map((point) => new Vector3(...toScene(...point))));
      this.extras.add(new Mesh(new TubeGeometry(curve, 80, 0.0007, 8), this.bone));
    }
  }

  /** Another model.glb; the camera stays where a user has put it. */
  take(tongue, first) {
    this.last = null;
    this.body.take(tongue);
    this.shadow.take(tongue);
    if (first) {
      this.frame(tongue, this.hello);
      this.reset();
    }
    this.stale = true;
  }

  /** Centre and size of the tongue in its mean pose, and of the palate. */
  frame(tongue, hello) {
    const low = new Vector3(Infinity, Infinity, Infinity), high = low.clone().negate(), point = new Vector3();
    for (let v = 0; v < tongue.base.count; v += 1) {
      point.fromBufferAttribute(tongue.base, v);
      tongue.targets.forEach((target) => {
        point.x += 0.5 * target.getX(v);
        point.y += 0.5 * target.getY(v);
        point.z += 0.5 * target.getZ(v);
      });
      low.min(point);
      high.max(point);
    }
    for (const place of hello.palate ?? []) {
      point.set(...toScene(...place));
      low.min(point);
      high.max(point);
    }
    this.centre.copy(low).add(high).multiplyScalar(0.5);
    this.reach = low.distanceTo(high) / 2;
  }

  reset() {
    this.controls.target.copy(this.centre);
    // Both directions have to fit into the picture.
    const half = (this.camera.fov * Math.PI) / 360;
    const narrow = Math.min(1, this.camera.aspect);
    const away = (0.86 * this.reach) / Math.sin(Math.atan(Math.tan(half) * narrow));
    this.camera.position.copy(FROM).normalize().multiplyScalar(away).add(this.centre);
    this.controls.update();
    this.untouched = true;
    this.stale = true;
  }

  theme(style) {
    const colour = (name) => new Color(style.getPropertyValue(name).trim());
    this.tissue.color = colour("--tissue");
    this.tissue.sheenColor = colour("--tissue").lerp(new Color(0xffffff), 0.35);
    this.veil.color = colour("--ghost");
    this.bone.color = colour("--palate");
    this.stick.color = colour("--ink");
    this.stale = true;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.place;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (!this.moved()) this.reset();
    this.stale = true;
  }

  /** Whether a user has turned or zoomed. */
  moved() {
    const along = this.camera.position.clone().sub(this.controls.target).normalize();
    return !this.untouched || along.distanceTo(FROM.clone().normalize()) > 1e-3;
  }

  ghost(pose) {
    this.shadow.group.visible = pose !== null;
    if (pose) this.shadow.show(pose);
    this.stale = true;
  }

  /** vertices: [[x, y, z], ...] mm, where the coils should be. */
  show(pose, vertices) {
    if (this.last && looksLike(this.last, pose)) return; // held, or the source is silent: nothing to draw
    this.last = pose;
    this.body.show(pose);
    const ends = this.sticks.geometry.attributes.position;
    this.coils.forEach(({ mesh }, i) => {
      const [x, y, z] = pose.coils.subarray(3 * i, 3 * i + 3);
      mesh.visible = Number.isFinite(x);
      const at = mesh.visible ? toScene(x, y, z) : toScene(...vertices[i]);
      mesh.position.set(...at);
      mesh.material.opacity = pose.states[i] ? 0.4 : 1;
      mesh.material.transparent = pose.states[i] > 0;
      ends.setXYZ(2 * i, ...at);
      ends.setXYZ(2 * i + 1, ...toScene(...vertices[i]));
    });
    ends.needsUpdate = true;
    this.stale = true;
  }

  /** Draws if anything has changed. */
  draw() {
    if (!this.stale) return;
    this.stale = false;
    this.renderer.render(this.scene, this.camera);
    const at = new Vector3(), { clientWidth: width, clientHeight: height } = this.place;
    for (const { mesh, label } of this.coils ?? []) {
      label.hidden = !mesh.visible;
      at.copy(mesh.position).project(this.camera);
      const x = Math.min(((at.x + 1) / 2) * width + 10, width - label.offsetWidth - 4);
      const y = ((1 - at.y) / 2) * height - 24;
      label.style.transform = `translate(${x.toFixed(1)}px, ${y.toFixed(1)}px)`;
    }
  }
}
