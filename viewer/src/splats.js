// Drawing of Gaussians: their ellipses sorted from the back, blended into a picture of their own, laid over the sky.
import * as THREE from "three";
import * as shaders from "./shaders.js";

const ACROSS = 1024;

export function makeSplats(gl, model, air, { texture, target, pass, run }) {
  const { about, count } = model;
  const down = Math.ceil(count / ACROSS);
  const centres = new Float32Array(ACROSS * down * 4);
  const axes = new Float32Array(3 * ACROSS * down * 4);
  for (let n = 0; n < count; n++) {
    centres.set([model.means[3 * n], model.means[3 * n + 1], model.means[3 * n + 2], model.opacity[n]], 4 * n);
    // Columns of each matrix (3, 3) one behind the other.
    for (let k = 0; k < 3; k++) for (let c = 0; c < 3; c++) axes[4 * (3 * n + k) + c] = model.axes[9 * n + 3 * c + k];
  }
  const colours = texture(new Float32Array(ACROSS * down * 4), ACROSS, down, THREE.RGBAFormat, THREE.FloatType);
  const material = new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader: shaders.SPLAT_VERTEX,
    fragmentShader: shaders.SPLAT,
    uniforms: {
      ...air,
      uCentre: { value: texture(centres, ACROSS, down, THREE.RGBAFormat, THREE.FloatType) },
      uAxes: { value: texture(axes, 3 * ACROSS, down, THREE.RGBAFormat, THREE.FloatType) },
      uColour: { value: colours }, uAcross: { value: ACROSS },
      uFocal: { value: 1 }, uPicture: { value: new THREE.Vector2() },
      // The jittered frames that are averaged stand for the samples of a pixel.
      uVariance: { value: about.pixel_variance }, uCut: { value: about.alpha_cut }, uMost: { value: about.alpha_most },
    },
    transparent: true, depthTest: false, depthWrite: false, side: THREE.DoubleSide,
    blending: THREE.CustomBlending, blendEquation: THREE.AddEquation,
    blendSrc: THREE.OneFactor, blendDst: THREE.OneMinusSrcAlphaFactor, blendSrcAlpha: THREE.OneFactor, blendDstAlpha: THREE.OneMinusSrcAlphaFactor,
  });
  const over = pass(shaders.SPLAT_OVER, { uFrame: { value: null }, uFull: { value: about.full_coverage } });
  Object.assign(over, { transparent: true, blending: THREE.CustomBlending, blendSrc: THREE.OneFactor, blendDst: THREE.OneMinusSrcAlphaFactor, blendSrcAlpha: THREE.OneFactor, blendDstAlpha: THREE.OneFactor });

  const geometry = new THREE.InstancedBufferGeometry();
  geometry.setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 1, -1, 0, 1, 1, 0, -1, 1, 0], 3));
  geometry.setIndex([0, 1, 2, 0, 2, 3]);
  const which = new THREE.InstancedBufferAttribute(new Float32Array(count), 1);
  which.setUsage(THREE.DynamicDrawUsage);
  geometry.setAttribute("which", which);
  geometry.instanceCount = count;
  const mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  const scene = new THREE.Scene().add(mesh);
  const seenFrom = { position: new THREE.Vector3(Infinity, 0, 0), forward: new THREE.Vector3() };
  let picture = null;
  let lit = null;
  let scaled = 0;

  /** Radiance [cd/m²] of all Gaussians. */
  function light(radiance) {
    lit = radiance;
    scaled = 0;
  }

  function upload(scale) {
    if (scaled === scale) return;
    scaled = scale;
    const data = colours.image.data;
    for (let n = 0; n < count; n++) for (let c = 0; c < 3; c++) data[4 * n + c] = lit[3 * n + c] * scale;
    colours.needsUpdate = true;
  }

  function sort(camera) {
    const forward = camera.getWorldDirection(new THREE.Vector3());
    if (camera.position.distanceToSquared(seenFrom.position) < 1e-4 && forward.distanceToSquared(seenFrom.forward) < 1e-10) return;
    seenFrom.position.copy(camera.position);
    seenFrom.forward.copy(forward);
    model.backToFront(camera.position.toArray(), forward.toArray(), which.array);
    which.needsUpdate = true;
  }

  /** Blend the Gaussians over a frame, within its scissors. */
  function draw(camera, frame, scale) {
    if (!lit) return;
    upload(scale);
    sort(camera);
    if (!picture || picture.width !== frame.width || picture.height !== frame.height) {
      picture?.dispose();
      picture = target(frame.width, frame.height, THREE.HalfFloatType, THREE.NearestFilter);
      over.uniforms.uFrame.value = picture.texture;
    }
    picture.scissorTest = true;
    picture.scissor.copy(frame.scissor);
    material.uniforms.uPicture.value.set(frame.width, frame.height);
    material.uniforms.uFocal.value = (0.5 * frame.height) / Math.tan((camera.fov * Math.PI) / 360);
    gl.setRenderTarget(picture);
    gl.setClearColor(0x000000, 0);
    gl.clear(true, false, false);
    gl.render(scene, camera);
    run(over, frame);
  }

  return { model, light, draw };
}
