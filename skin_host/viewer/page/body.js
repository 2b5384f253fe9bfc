// Curved parts in space, drawn by three.js: what is in front hides what is behind.
import { paper, ramp, shareOf } from "./colours.js";

/** Marks lie this far above the skin (mm), so that it does not hide them. */
const ABOVE_MM = 0.4;
const FAR = 1e5;

/** What draws below a canvas; null without the library, which is not in the repository, or WebGL. */
export async function drawer(below) {
  try {
    const three = await import("./vendor/three.module.min.js");
    const body = new Body(three);
    below.before(body.canvas);
    return body;
  } catch (error) {
    console.warn(`curved parts are drawn without three.js: ${error}`);
    return null;
  }
}

class Body {
  constructor(three) {
    this.three = three;
    this.renderer = new three.WebGLRenderer({ alpha: true, antialias: true, preserveDrawingBuffer: true });
    this.canvas = this.renderer.domElement;
    this.canvas.id = "body";
    this.canvas.ariaHidden = "true";
    this.lost = false;
    this.canvas.addEventListener("webglcontextlost", () => { this.lost = true; });
    this.scene = new three.Scene();
    this.camera = new three.OrthographicCamera(-1, 1, 1, -1, -FAR, FAR);
    const light = new three.DirectionalLight(0xffffff, 1.2);
    light.position.set(-0.4, 0.6, 1);
    this.scene.add(light, new three.AmbientLight(0xffffff, 2.2));
    this.models = new Map();
    this.ray = new three.Raycaster();
  }

  /** Parts have come or changed. */
  relayout() {
    for (const model of this.models.values()) model.dispose(this.scene);
    this.models.clear();
  }

  model(part) {
    if (!this.models.has(part.name)) this.models.set(part.name, new Model(this.three, this.scene, part));
    return this.models.get(part.name);
  }

  /** Draw parts where the map puts them: [{ part, pose, x, y }], x and y of the pose's centre in px. */
  draw(places, { width, height, ratio, scale, raw, top, nowMs }) {
    const size = `${width} ${height} ${ratio}`;
    if (size !== this.size) {
      this.size = size;
      this.renderer.setPixelRatio(ratio);
      this.renderer.setSize(width, height, false);
    }
    Object.assign(this.camera, { left: -width / 2, right: width / 2, top: height / 2, bottom: -height / 2 });
    this.camera.updateProjectionMatrix();
    for (const model of this.models.values()) model.group.visible = false;
    for (const { part, pose, x, y } of places) {
      const model = this.model(part);
      model.group.visible = true;
      model.put(pose, x - width / 2, height / 2 - y, scale);
      model.colour(part, raw, top, nowMs);
    }
    this.renderer.render(this.scene, this.camera);
  }

  /** What a point of the canvas shows of a part: the place on its skin in mm, or null. */
  hit(part, sx, sy, width, height) {
    const model = this.models.get(part.name);
    if (!model) return null;
    this.ray.setFromCamera({ x: (2 * sx) / width - 1, y: 1 - (2 * sy) / height }, this.camera);
    const [found] = this.ray.intersectObject(model.skin, false);
    return found ? model.skin.worldToLocal(found.point.clone()).toArray() : null;
  }
}

/** One part: its triangles as panels, its taxels as discs on them, and marks for their states. */
class Model {
  constructor(three, scene, part) {
    this.three = three;
    this.group = new three.Group();
    this.group.matrixAutoUpdate = false;
    const corners = [];
    const edges = [];
    part.triangles.forEach(({ outline }, k) => {
      // Units of several triangles have one outline.
      if (k && part.triangles[k - 1].outline.every((p, i) => p.every((v, axis) => v === outline[i]?.[axis]))) return;
      for (let i = 1; i + 1 < outline.length; i++) corners.push(...outline[0], ...outline[i], ...outline[i + 1]);
      outline.forEach((p, i) => edges.push(...p, ...outline[(i + 1) % outline.length]));
    });
    this.skin = new three.Mesh(this.geometry(corners, true), new three.MeshLambertMaterial({ side: three.DoubleSide, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 }));
    this.edges = new three.LineSegments(this.geometry(edges, false), new three.LineBasicMaterial());
    const up = new three.Vector3(0, 0, 1);
    this.places = part.position.map((p, i) => {
      const normal = new three.Vector3(...part.normal[i]);
      return { at: new three.Vector3(...p).addScaledVector(normal, ABOVE_MM), turn: new three.Quaternion().setFromUnitVectors(up, normal) };
    });
    this.discs = this.marks(new three.CircleGeometry(1, 18), part.n);
    this.rims = this.marks(new three.RingGeometry(1, 1.09, 18), part.n);
    this.crosses = this.marks(cross(three), part.n);
    this.squares = this.marks(new three.RingGeometry(0.55, 0.7, 4, 1, Math.PI / 4), part.n);
    this.rings = this.marks(new three.RingGeometry(1.15, 1.4, 18), part.n);
    this.kinds = [this.discs, this.rims, this.crosses, this.squares, this.rings];
    this.group.add(this.skin, this.edges, ...this.kinds);
    this.states = new Float32Array(part.n).fill(-1); // marks of each taxel and their size
    this.discOf = []; // which taxel each disc is
    scene.add(this.group);
  }

  geometry(corners, shaded) {
    const made = new this.three.BufferGeometry();
    made.setAttribute("position", new this.three.Float32BufferAttribute(corners, 3));
    if (shaded) made.computeVertexNormals();
    return made;
  }

  /** Copies of a mark for up to n taxels; those that face away are not drawn. */
  marks(geometry, n) {
    const made = new this.three.InstancedMesh(geometry, new this.three.MeshBasicMaterial(), Math.max(1, n));
    made.frustumCulled = false;
    made.count = 0;
    return made;
  }

  put({ axes: [right, up, eye], centre }, x, y, scale) {
    const { Matrix4 } = this.three;
    this.group.matrix.makeTranslation(x, y, 0)
      .multiply(new Matrix4().makeScale(scale, scale, scale))
      .multiply(new Matrix4().set(...right, 0, ...up, 0, ...eye, 0, 0, 0, 0, 1))
      .multiply(new Matrix4().makeTranslation(-centre[0], -centre[1], -centre[2]));
    this.group.updateMatrixWorld(true);
  }

  colour(part, raw, top, nowMs) {
    const look = paper();
    const colours = this.colours();
    this.skin.material.color.set(look.body);
    this.edges.material.color.set(look.rim);
    for (const [mesh, colour] of [[this.rims, look.rim], [this.crosses, look.dim], [this.squares, look.dim], [this.rings, look.alarm]]) mesh.material.color.set(colour);
    const blank = part.isBlank(nowMs);
    let changed = false;
    for (let i = 0; i < part.n; i++) {
      const thermal = part.thermal[i] && !raw;
      const known = !blank && !thermal && (raw ? part.hasRaw(i) : part.valid(i));
      const crossed = !blank && !thermal && !(known && (part.valid(i) || part.thermal[i]));
      const ringed = known && !raw && part.beyond(i);
      const bits = known * 1 + (known || (blank && !thermal)) * 2 + crossed * 4 + thermal * 8 + ringed * 16;
      const state = bits + (part.thermal[i] && raw ? 32 : 0);
      if (this.states[i] !== state) { this.states[i] = state; changed = true; }
    }
    if (changed) this.arrange(part);
    this.discOf.forEach((i, k) => {
      const value = raw ? part.noLoad[i] - part.raw[i] : part.pressure[i];
      this.discs.setColorAt(k, colours[Math.round(255 * shareOf(value, top))]);
    });
    if (this.discs.instanceColor) this.discs.instanceColor.needsUpdate = true;
  }

  /** Put each mark on the taxels that have it now: only those cost time. */
  arrange(part) {
    const { Matrix4, Vector3 } = this.three;
    this.discOf = [];
    for (const mesh of this.kinds) { mesh.count = 0; mesh.instanceMatrix.needsUpdate = true; }
    this.places.forEach(({ at, turn }, i) => {
      const size = part.radius[i] * (this.states[i] & 32 ? 0.6 : 1);
      const matrix = new Matrix4().compose(at, turn, new Vector3(size, size, size));
      if (this.states[i] & 1) this.discOf.push(i);
      this.kinds.forEach((mesh, k) => { if (this.states[i] & (1 << k)) mesh.setMatrixAt(mesh.count++, matrix); });
    });
  }

  colours() {
    const known = ramp();
    if (this.known !== known) {
      this.known = known;
      this.palette = known.map((colour) => new this.three.Color(colour));
    }
    return this.palette;
  }

  dispose(scene) {
    scene.remove(this.group);
    for (const mesh of this.group.children) { mesh.geometry.dispose(); mesh.material.dispose(); mesh.dispose?.(); }
  }
}

/** Two bars of a cross that fits into a disc of radius 1. */
function cross(three) {
  const [a, b] = [0.66, 0.09];
  const bars = [1, -1].flatMap((slope) => {
    const [x, y] = [a, a * slope];
    const [dx, dy] = [b * slope, -b];
    const corners = [[-x - dx, -y - dy], [x - dx, y - dy], [x + dx, y + dy], [-x + dx, -y + dy]];
    return [0, 2, 1, 0, 3, 2].map((k) => corners[k]);
  });
  const made = new three.BufferGeometry();
  made.setAttribute("position", new three.Float32BufferAttribute(bars.flatMap(([x, y]) => [x, y, 0]), 3));
  return made;
}
