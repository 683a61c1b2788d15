// The tongue of model.glb: where single vertices are in any pose. Millimetres in the model's frame
// (x left, y front to back, z up); model.glb itself is in metres, y up, as glTF wants it.

import { GLTFLoader } from "./three.bundle.js";

/** Model frame (mm) to glTF (m). */
export function toScene(x, y, z) {
  return [x / 1000, z / 1000, -y / 1000];
}

export class Tongue {
  /** mesh: of three.js, with one morph target per coefficient; hello: what the server said first. */
  constructor(mesh, hello, number) {
    this.mesh = mesh;
    this.number = number;
    this.low = hello.coefficients.low;
    this.high = hello.coefficients.high;
    this.base = mesh.geometry.attributes.position;
    this.targets = mesh.geometry.morphAttributes.position ?? [];
  }

  static async load(hello, number) {
    const gltf = await new GLTFLoader().loadAsync(`model.glb?${number}`);
    let found = null;
    gltf.scene.traverse((node) => {
      if (!found && node.isMesh && (node.geometry.morphAttributes.position ?? []).length) found = node;
    });
    if (!found) throw new Error("model.glb holds no tongue");
    return new Tongue(found, hello, number);
  }

  /** The weights of the morph targets: 0 to 1 between the published low and high. */
  unit(weights) {
    return Array.from(weights, (weight, k) => (weight - this.low[k]) / (this.high[k] - this.low[k]));
  }

  /** The points of some vertices, [[x, y, z], ...] in mm, model frame. */
  points(vertices, pose) {
    if (pose.vertices) return vertices.map((v) => Array.from(pose.vertices.subarray(3 * v, 3 * v + 3)));
    const unit = this.unit(pose.weights);
    return vertices.map((v) => {
      let x = this.base.getX(v), y = this.base.getY(v), z = this.base.getZ(v);
      this.targets.forEach((target, k) => {
        x += unit[k] * target.getX(v);
        y += unit[k] * target.getY(v);
        z += unit[k] * target.getZ(v);
      });
      return [1000 * x, -1000 * z, 1000 * y];
    });
  }
}
