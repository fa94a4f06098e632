"use strict";
/* Scene in space: the bodies of the glTF file, moved to the poses of each frame.
   Lengths are in metres, in the base frame. */

function numbers(text, Kind) {
  return new Kind(Uint8Array.from(atob(text), (character) => character.charCodeAt(0)).buffer);
}

/* Return base_from_platform of a pose [x y z alpha beta gamma], with R = Rx(alpha) Ry(beta) Rz(gamma).
   poseOf is the inverse. */
function transformOf(pose) {
  const turn = new THREE.Quaternion().setFromEuler(new THREE.Euler(pose[3], pose[4], pose[5], "XYZ"));
  return new THREE.Matrix4().compose(new THREE.Vector3(...pose), turn, new THREE.Vector3(1, 1, 1));
}

function poseOf(matrix) {
  const place = new THREE.Vector3().setFromMatrixPosition(matrix);
  const turn = new THREE.Euler().setFromRotationMatrix(matrix, "XYZ");
  return [place.x, place.y, place.z, turn.x, turn.y, turn.z];
}

/* Return the transform `to`, with its difference from the transform `from` enlarged by a factor. */
function enlargedTransform(from, to, times) {
  const [place, other, one] = [new THREE.Vector3(), new THREE.Vector3(), new THREE.Vector3()];
  const [turn, turned] = [new THREE.Quaternion(), new THREE.Quaternion()];
  from.decompose(place, turn, one);
  to.decompose(other, turned, one);
  const step = turned.multiply(turn.clone().invert());
  const axis = new THREE.Vector3(step.x, step.y, step.z);
  const angle = 2 * Math.atan2(axis.length(), step.w);
  if (axis.length() > 0) turn.premultiply(new THREE.Quaternion().setFromAxisAngle(axis.normalize(), times * angle));
  place.add(other.sub(place).multiplyScalar(times));
  return new THREE.Matrix4().compose(place, turn, new THREE.Vector3(1, 1, 1));
}

/* Return a colour of the page in the linear space of three.js. */
function linear(colour) {
  return new THREE.Color(colour).convertSRGBToLinear();
}

function canDraw() {
  const canvas = document.createElement("canvas");
  return Boolean(window.WebGLRenderingContext && (canvas.getContext("webgl2") || canvas.getContext("webgl")));
}

class Scene {
  constructor(data, figure, poses) {
    this.data = data;
    this.poses = poses; /* function of kind and frame that returns a pose, or null if there is none */
    this.figure = figure;
    this.rods = numbers(data.rods, Float32Array);
    this.ellipsoids = data.ellipsoid && numbers(data.ellipsoid, Float32Array);
    this.world = new THREE.Scene();
    this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
    this.renderer.outputEncoding = THREE.sRGBEncoding;
    this.renderer.setPixelRatio(window.devicePixelRatio);
    this.eye = new THREE.PerspectiveCamera(32, 1, 0.01, 100);
    this.eye.up.set(0, 0, 1);
    this.layers = {};
  }

  /* Read the glTF file and build the scene. Resolves when the first picture can be drawn. */
  async build(colours) {
    const raw = numbers(this.data.gltf, Uint8Array).buffer;
    const gltf = await new Promise((done, failed) => new THREE.GLTFLoader().parse(raw, "", done, failed));
    this.bodies = gltf.scene;
    this.world.add(gltf.scene, new THREE.HemisphereLight(0xffffff, 0x8a8f98, 0.85));
    const sun = new THREE.DirectionalLight(0xffffff, 0.6);
    sun.position.set(0.6, -0.9, 1.3);
    this.world.add(sun);
    this.platform = this.node("platform");
    this.parts = this.data.parts.map((name) => this.node(name));
    for (const name of ["platform", "base"]) this.outline(this.node(name), 0x22262b);
    this.layer("legs", this.parts.length ? [...this.parts, this.segments(this.data.frame, colours.soft)] : []);
    this.addCameras(colours);
    this.addKinds(colours);
    this.figure.prepend(this.renderer.domElement);
    this.lookAtAll();
    this.controls = new THREE.TrackballControls(this.eye, this.renderer.domElement);
    Object.assign(this.controls, { staticMoving: true, rotateSpeed: 3, target: this.middle });
    this.controls.addEventListener("change", () => this.draw());
    new ResizeObserver(() => this.resize()).observe(this.renderer.domElement);
    this.resize();
    const turn = () => {
      this.controls.update();
      if (this.stale) this.renderer.render(this.world, this.eye);
      this.stale = false;
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
  }

  node(name) {
    return this.bodies.getObjectByName(THREE.PropertyBinding.sanitizeNodeName(name)) || null;
  }

  layer(name, objects) {
    this.layers[name] = objects.filter(Boolean);
    for (const object of this.layers[name]) if (!object.parent) this.world.add(object);
  }

  showLayer(name, shown) {
    for (const object of this.layers[name] || []) object.layers.set(shown ? 0 : 1);
    for (const object of this.layers[name] || []) object.traverse((child) => child.layers.set(shown ? 0 : 1));
  }

  segments(pairs, colour, opacity = 1) {
    const points = pairs.flat().map((point) => new THREE.Vector3(...point));
    const material = new THREE.LineBasicMaterial({ color: linear(colour), transparent: opacity < 1, opacity });
    return new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), material);
  }

  outline(node, colour, onTop = false) {
    let mesh = null;
    if (node) node.traverse((child) => { if (child.isMesh && !mesh) mesh = child; });
    if (!mesh) return null;
    const material = new THREE.LineBasicMaterial({ color: linear(colour), depthTest: !onTop, transparent: onTop });
    const lines = new THREE.LineSegments(new THREE.EdgesGeometry(mesh.geometry, 5), material);
    if (!onTop) node.add(lines);
    return lines;
  }

  addCameras(colours) {
    const frusta = [];
    for (const camera of this.data.cameras) {
      camera.corners.forEach((corner, k) => {
        frusta.push([camera.centre, corner], [corner, camera.corners[(k + 1) % 4]]);
      });
    }
    const boxes = this.data.cameras.map((camera) => this.node(`${camera.name} camera`));
    this.layer("cameras", boxes.length ? [...boxes, this.segments(frusta, colours.soft)] : []);
    this.rays = this.segments([], "#c8102e", 0.5);
    this.layer("rays", this.data.looks.length ? [this.rays] : []);
  }

  /* Add outlines of the platform at measured and modelled poses, with enlarged differences, and the
     ellipsoids. The groups named "exact" have no content; they store the poses that shown() reads. */
  addKinds(colours) {
    this.exact = {};
    this.ghosts = {};
    for (const kind of Object.keys(this.data.poses)) {
      if (kind === "true") continue;
      this.exact[kind] = new THREE.Group();
      this.ghosts[kind] = new THREE.Group();
      const lines = this.outline(this.platform, colours[kind], true);
      const shift = this.segments([[[0, 0, 0], [0, 0, 0]]], colours[kind]);
      shift.material.depthTest = false;
      shift.frustumCulled = false;
      this.ghosts[kind].add(lines);
      this.ghosts[kind].userData.shift = shift;
      for (const group of [this.exact[kind], this.ghosts[kind]]) group.matrixAutoUpdate = false;
      this.layer(kind, [this.exact[kind], this.ghosts[kind], shift]);
    }
    this.ball = new THREE.SphereGeometry(1, 24, 16);
    this.spread = this.ellipsoid(colours.measured);
    this.layer("ellipsoid", this.ellipsoids ? [this.spread] : []);
    this.stickers = {};
    for (const name of ["platform", "base"]) {
      this.stickers[name] = (this.data.bodies[name] || { ids: [] }).ids.map(() => this.ellipsoid(colours[name]));
    }
    this.layer("stickers", this.data.looks.length ? Object.values(this.stickers).flat() : []);
  }

  ellipsoid(colour) {
    const settings = { color: linear(colour), transparent: true, opacity: 0.5, depthTest: false, depthWrite: false };
    const mesh = new THREE.Mesh(this.ball, new THREE.MeshLambertMaterial(settings));
    mesh.matrixAutoUpdate = false;
    mesh.frustumCulled = false;
    return mesh;
  }

  /* Move everything to a frame. look is the nearest frame with images, or null. times is the factor that
     enlarges differences. */
  show(frame, look, times) {
    const drawn = transformOf(this.poses("drawn", frame));
    this.move(this.platform, drawn);
    this.parts.forEach((part, k) => this.move(part, this.rod(frame, k)));
    for (const kind of Object.keys(this.exact)) {
      const pose = this.poses(kind, frame);
      const ghost = this.ghosts[kind];
      this.exact[kind].visible = Boolean(pose);
      ghost.visible = ghost.userData.shift.visible = Boolean(pose);
      if (!pose) continue;
      this.move(this.exact[kind], transformOf(pose));
      const place = enlargedTransform(drawn, this.exact[kind].matrix, times);
      this.move(ghost, place);
      const ends = [drawn, place].map((matrix) => new THREE.Vector3().setFromMatrixPosition(matrix));
      ghost.userData.shift.geometry.setFromPoints(ends);
    }
    this.showEllipsoid(frame, times);
    this.showLook(look, drawn, times);
    this.draw();
  }

  showEllipsoid(frame, times) {
    if (!this.ellipsoids) return;
    const shape = this.ellipsoids.subarray(9 * frame, 9 * frame + 9);
    this.spread.visible = Number.isFinite(shape[0]) && this.ghosts.measured.visible;
    if (this.spread.visible) this.move(this.spread, this.stretched(shape, times, this.ghosts.measured.matrix));
  }

  showLook(look, drawn, times) {
    if (!look) return;
    const rays = [];
    const then = transformOf(this.poses("drawn", look.frame));
    for (const [name, found] of Object.entries(look.found)) {
      const [now, before] = name === "platform" ? [drawn, then] : [new THREE.Matrix4(), new THREE.Matrix4()];
      const body = this.data.bodies[name];
      this.stickers[name].forEach((mesh) => { mesh.visible = false; });
      found.ids.forEach((id, k) => {
        const own = body.places[body.ids.indexOf(id)];
        const [place, then] = [now, before].map((matrix) => new THREE.Vector3(...own).applyMatrix4(matrix));
        if (name === "platform") {
          for (const camera of this.data.cameras) rays.push(new THREE.Vector3(...camera.centre), place);
        }
        const error = new THREE.Vector3(...found.points[k]).sub(then).multiplyScalar(times);
        const mesh = this.stickers[name][body.ids.indexOf(id)];
        mesh.visible = true;
        const centre = new THREE.Matrix4().setPosition(place.clone().add(error));
        this.move(mesh, this.stretched(found.ellipsoids[k].flat(), times, centre));
      });
    }
    this.rays.geometry.dispose();
    this.rays.geometry = new THREE.BufferGeometry().setFromPoints(rays);
  }

  stretched(shape, times, at) {
    const s = Array.from(shape, (value) => times * value);
    const place = new THREE.Vector3().setFromMatrixPosition(at);
    const rows = [s[0], s[1], s[2], place.x, s[3], s[4], s[5], place.y, s[6], s[7], s[8], place.z, 0, 0, 0, 1];
    return new THREE.Matrix4().set(...rows);
  }

  rod(frame, part) {
    const [a, b, c, d, e, f] = this.rods.subarray(6 * (frame * this.parts.length + part));
    const along = new THREE.Vector3(d - a, e - b, f - c).normalize();
    const turn = new THREE.Quaternion().setFromUnitVectors(new THREE.Vector3(0, 0, 1), along);
    return new THREE.Matrix4().compose(new THREE.Vector3(a, b, c), turn, new THREE.Vector3(1, 1, 1));
  }

  move(object, matrix) {
    object.matrixAutoUpdate = false;
    object.matrix.copy(matrix);
    object.matrixWorldNeedsUpdate = true;
  }

  /* Return the poses of the objects, read from their matrices. */
  shown() {
    this.world.updateMatrixWorld(true);
    const found = { drawn: poseOf(this.platform.matrixWorld) };
    for (const [kind, group] of Object.entries(this.exact)) {
      found[kind] = group.visible ? poseOf(group.matrixWorld) : null;
    }
    return found;
  }

  lookAtAll() {
    const box = new THREE.Box3().setFromObject(this.bodies);
    this.middle = box.getCenter(new THREE.Vector3());
    this.size = box.getSize(new THREE.Vector3()).length();
    this.eye.position.set(0.592, -0.705, 0.391).multiplyScalar(1.3 * this.size).add(this.middle);
    this.eye.lookAt(this.middle);
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    if (!width || !height) return;
    this.eye.aspect = width / height;
    this.eye.fov = (360 / Math.PI) * Math.atan(Math.max(0.28, 0.37 / this.eye.aspect));
    this.eye.updateProjectionMatrix();
    this.renderer.setSize(width, height, false);
    this.controls.handleResize();
    this.draw();
  }

  /* Request one drawing at the browser's next frame, however often this is called before. */
  draw() {
    this.stale = true;
  }
}
