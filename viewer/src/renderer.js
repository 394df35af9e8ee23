// The pipeline: visibility of sun and moon, light on clusters and ground, then ground and sky into a frame of radiance,
// which is averaged over jittered frames while nothing moves, and developed as a photograph.
import * as THREE from "three";
import * as shaders from "./shaders.js";
import { AIR_AZIMUTHS, SKY_AZIMUTHS } from "./light.js";
import { makeSplats } from "./splats.js";
import { CELLS, chooseChunks, chunkGeometry } from "./terrain.js";

const SATURATION = 1.2;
const GAIN = 1.6;
const BRADFORD = [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]];
const XYZ = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.072175], [0.0193339, 0.119192, 0.9503041]];
const MOST_CHUNKS = 8192;
const METER = [96, 64];

const half = (value) => THREE.DataUtils.toHalfFloat(Math.min(Math.max(value, -65000), 65000));

export function makeRenderer(canvas, { arrays, about }, terrain, light) {
  const gl = new THREE.WebGLRenderer({ canvas, antialias: false, alpha: false, powerPreference: "high-performance", preserveDrawingBuffer: true });
  gl.outputColorSpace = THREE.LinearSRGBColorSpace;
  gl.autoClear = false;
  const context = gl.getContext();
  if (!gl.extensions.has("EXT_color_buffer_float")) throw new Error("this browser cannot draw into floating-point pictures");
  const naming = context.getExtension("WEBGL_debug_renderer_info");
  const device = String(naming ? context.getParameter(naming.UNMASKED_RENDERER_WEBGL) : context.getParameter(context.RENDERER));
  const software = /swiftshader|llvmpipe|software/i.test(device);

  const quad = new THREE.Mesh(new THREE.BufferGeometry().setAttribute("position", new THREE.Float32BufferAttribute([-1, -1, 0, 3, -1, 0, -1, 3, 0], 3)));
  quad.frustumCulled = false;
  const flat = new THREE.Scene().add(quad);
  const still = new THREE.Camera();
  const pass = (fragmentShader, uniforms) =>
    new THREE.RawShaderMaterial({ glslVersion: THREE.GLSL3, vertexShader: shaders.FULL_SCREEN, fragmentShader, uniforms, depthTest: false, depthWrite: false });
  const run = (material, target) => {
    quad.material = material;
    gl.setRenderTarget(target);
    gl.render(flat, still);
  };
  const target = (width, height, type, filter = THREE.LinearFilter, more = {}) =>
    new THREE.WebGLRenderTarget(width, height, { type, minFilter: filter, magFilter: filter, depthBuffer: false, generateMipmaps: false, ...more });

  const texture = (data, width, height, format, type, filter = THREE.NearestFilter) => {
    const made = new THREE.DataTexture(data, width, height, format, type);
    [made.minFilter, made.magFilter, made.needsUpdate] = [filter, filter, true];
    return made;
  };
  const layers = (data, width, height, depth, format, type, internal) => {
    const made = new THREE.DataArrayTexture(data, width, height, depth);
    [made.format, made.type, made.minFilter, made.magFilter] = [format, type, THREE.NearestFilter, THREE.NearestFilter];
    if (internal) made.internalFormat = internal;
    [made.unpackAlignment, made.needsUpdate] = [1, true];
    return made;
  };

  // Heights, their slopes, and the greatest heights of blocks.
  const nodes = new Int32Array([terrain.columns, terrain.rows]);
  const heightTexture = texture(terrain.up, terrain.columns, terrain.rows, THREE.RedFormat, THREE.FloatType);
  const slopeTexture = texture(terrain.slopes(), terrain.columns, terrain.rows, THREE.RGFormat, THREE.HalfFloatType, THREE.LinearFilter);
  const maskTexture = texture(terrain.known, terrain.columns, terrain.rows, THREE.RedFormat, THREE.UnsignedByteType);
  maskTexture.unpackAlignment = 1;
  const levels = terrain.pyramid();
  const mostTexture = texture(levels[0].data, levels[0].width, levels[0].height, THREE.RedFormat, THREE.FloatType);
  mostTexture.mipmaps = levels;
  mostTexture.minFilter = THREE.NearestMipmapNearestFilter;

  // Coefficients of the sky, lists of clusters.
  const [skyRows, skyColumns, rank] = arrays.sky_levels.shape;
  const skyLevels = layers(byLayers(arrays.sky_levels.data, skyRows * skyColumns, rank), skyColumns, skyRows, rank / 4, THREE.RGBAFormat, THREE.UnsignedByteType);
  const [bounceRows, bounceColumns, listed] = arrays.bounce_cluster.shape;
  const integers = [THREE.RGBAIntegerFormat, THREE.UnsignedShortType, "RGBA16UI"];
  const bounceLists = layers(byLayers(arrays.bounce_cluster.data, bounceRows * bounceColumns, listed), bounceColumns, bounceRows, listed / 4, ...integers);
  const bounceShare = texture(arrays.bounce_share.data, bounceColumns, bounceRows, THREE.RedFormat, THREE.UnsignedByteType);
  bounceShare.unpackAlignment = 1;
  // Any number of clusters, in a square whose last texels are of none.
  const clusters = arrays.cluster_share.shape[0];
  const side = Math.ceil(Math.sqrt(clusters));
  const clusterLevels = layers(byLayers(arrays.cluster_levels.data, clusters, rank, side * side), side, side, rank / 4, THREE.RGBAFormat, THREE.UnsignedByteType);
  const clusterLists = layers(byLayers(arrays.cluster_cluster.data, clusters, listed, side * side), side, side, listed / 4, ...integers);
  const shares = new Uint8Array(side * side);
  shares.set(arrays.cluster_share.data);
  const clusterShare = texture(shares, side, side, THREE.RedFormat, THREE.UnsignedByteType);
  clusterShare.unpackAlignment = 1;
  const points = new Uint16Array(side * side * 4 * 4);
  for (let m = 0; m < clusters; m++) {
    for (let k = 0; k < 4; k++) for (let c = 0; c < 2; c++) points[(k * side * side + m) * 4 + c] = arrays.cluster_uv.data[(m * 4 + k) * 2 + c];
  }
  const clusterPoints = layers(points, side, side, 4, ...integers);
  const range = [];
  for (let r = 0; r < 16; r++) range.push(r < rank ? new THREE.Vector2(arrays.sky_range.data[r], arrays.sky_range.data[rank + r]) : new THREE.Vector2());
  const orderShape = arrays.snow_order ? arrays.snow_order.shape : [1, 1];
  const orderTexture = texture(arrays.snow_order ? arrays.snow_order.data : new Uint8Array(1), orderShape[1], orderShape[0], THREE.RedFormat, THREE.UnsignedByteType, THREE.LinearFilter);
  orderTexture.unpackAlignment = 1;

  const shared = {
    uHeight: { value: heightTexture },
    uSlope: { value: slopeTexture },
    uMask: { value: maskTexture },
    uMost: { value: mostTexture },
    uNodes: { value: nodes },
    uStep: { value: terrain.step },
    uLevels: { value: levels.length },
    uDirection: { value: [new THREE.Vector3(), new THREE.Vector3()] },
    uRadius: { value: [0.0047, 0.0045] },
    uActive: { value: new Int32Array([0, 0]) },
    uLight: { value: [new THREE.Vector3(), new THREE.Vector3()] },
    uSeen: { value: null },
    uAlbedoA: { value: null },
    uAlbedoB: { value: null },
    uGainA: { value: new THREE.Vector3(1, 1, 1) },
    uGainB: { value: new THREE.Vector3(1, 1, 1) },
    uOrder: { value: orderTexture },
    uOrderLow: { value: 0 },
    uOrderHigh: { value: 1 },
    uSeason: { value: 0 },
    uSky: { value: Array.from({ length: 16 }, () => new THREE.Vector3()) },
    uRange: { value: range },
    uRank: { value: rank },
    uSide: { value: side },
    uPhase: { value: null },
    uAerosol: { value: new THREE.Vector3(...light.aerosolDepth) },
    uGamma: { value: light.gamma },
    uBody: { value: new THREE.Vector3(0, 0, 1) },
  };
  const phaseShape = arrays.phase.shape;
  shared.uPhase.value = texture(Uint16Array.from(arrays.phase.data, half), phaseShape[1], phaseShape[0], THREE.RedFormat, THREE.HalfFloatType, THREE.LinearFilter);

  let seen = null;
  const firstTarget = target(side, side, THREE.FloatType, THREE.NearestFilter, { count: 2 });
  const clusterTargets = [0, 1].map(() => target(side, side, THREE.FloatType, THREE.NearestFilter));
  const bounceTarget = target(bounceColumns, bounceRows, THREE.HalfFloatType);
  const diffuseTarget = target(skyColumns, skyRows, THREE.HalfFloatType);

  const visibility = pass(shaders.VISIBILITY, shared);
  const clusterFirst = pass(shaders.CLUSTER_FIRST, { ...shared, uPoints: { value: clusterPoints }, uLevels: { value: clusterLevels } });
  const clusterNext = pass(shaders.CLUSTER_NEXT, {
    uLists: { value: clusterLists }, uShare: { value: clusterShare }, uRadiance: { value: null }, uLayers: { value: listed / 4 }, uSide: { value: side },
    uFirst: { value: firstTarget.textures[0] }, uReflectance: { value: firstTarget.textures[1] },
  });
  const bounce = pass(shaders.BOUNCE, { uLists: { value: bounceLists }, uShare: { value: bounceShare }, uRadiance: { value: null }, uLayers: { value: listed / 4 }, uSide: { value: side } });
  const diffuse = pass(shaders.DIFFUSE, { ...shared, uLevels: { value: skyLevels }, uBounce: { value: bounceTarget.texture }, uBounceScale: { value: 1 } });

  // Air and sky.
  const airRows = light.rows.air;
  const columns = light.distances.length;
  const airTextures = ["Gas", "Aerosol", "Other", "Depth"].map(() => {
    const made = new THREE.Data3DTexture(new Uint16Array(AIR_AZIMUTHS * columns * airRows * 4), AIR_AZIMUTHS, columns, airRows);
    [made.format, made.type, made.minFilter, made.magFilter] = [THREE.RGBAFormat, THREE.HalfFloatType, THREE.LinearFilter, THREE.LinearFilter];
    made.wrapS = THREE.RepeatWrapping;
    return made;
  });
  const skyTextures = ["Gas", "Aerosol", "Other"].map(() => {
    const made = texture(new Uint16Array(SKY_AZIMUTHS * light.rows.sky * 4), SKY_AZIMUTHS, light.rows.sky, THREE.RGBAFormat, THREE.HalfFloatType, THREE.LinearFilter);
    made.wrapS = THREE.RepeatWrapping;
    return made;
  });
  const nightTexture = texture(new Uint16Array(64 * 4), 1, 64, THREE.RGBAFormat, THREE.HalfFloatType, THREE.LinearFilter);
  const distances = new Float32Array(16);
  distances.set(light.distances);
  const air = {
    uPhase: shared.uPhase, uAerosol: shared.uAerosol, uGamma: shared.uGamma, uBody: shared.uBody,
    uEye: { value: new THREE.Vector3() },
    uAirGas: { value: airTextures[0] }, uAirAerosol: { value: airTextures[1] }, uAirOther: { value: airTextures[2] }, uAirDepth: { value: airTextures[3] },
    uHaze: { value: 1 }, uHazeShare: { value: new THREE.Vector3(...light.hazeShare()) }, uAirOn: { value: 1 },
    uDistances: { value: distances }, uColumns: { value: columns },
    uHorizon: { value: 0 }, uAirRows: { value: new THREE.Vector2(light.rows.airBelow, airRows - light.rows.airBelow) },
  };
  const tiles = terrain.tiles();
  const noTile = layers(new Uint8Array(1), 1, 1, 1, THREE.RedFormat, THREE.UnsignedByteType);
  const ground = new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader: shaders.TERRAIN_VERTEX,
    fragmentShader: shaders.TERRAIN,
    side: THREE.DoubleSide,
    uniforms: {
      ...shared, ...air,
      uDiffuse: { value: diffuseTarget.texture },
      uWest: { value: new THREE.Vector2(terrain.west, terrain.south) },
      uTileHeight: { value: tiles?.heights ?? noTile }, uTileSlope: { value: tiles?.slopes ?? noTile },
      uTile: { value: tiles?.places ?? Array.from({ length: 48 }, () => new THREE.Vector3()) },
      uShadows: { value: 1 },
      uMark: { value: 0 }, uMarkAt: { value: new THREE.Vector2() },
    },
  });
  const dome = pass(shaders.SKY, {
    ...shared,
    uSkyGas: { value: skyTextures[0] }, uSkyAerosol: { value: skyTextures[1] }, uSkyOther: { value: skyTextures[2] }, uNight: { value: nightTexture },
    uRays: { value: new THREE.Matrix4() }, uHorizon: { value: 0 }, uPixel: { value: 0.001 },
    uDiscTo: { value: [new THREE.Vector3(), new THREE.Vector3()] },
    uDiscLight: { value: [new THREE.Vector3(), new THREE.Vector3()] },
    uDiscRadius: { value: [0, 0] }, uMoonSun: { value: new THREE.Vector3(0, 0, 1) },
    uSkyRows: { value: new THREE.Vector2(light.rows.skyBelow, light.rows.sky - light.rows.skyBelow) },
  });
  dome.depthTest = true;
  dome.depthFunc = THREE.LessEqualDepth;

  const geometry = chunkGeometry();
  const instances = new THREE.InstancedBufferAttribute(new Float32Array(MOST_CHUNKS * 4), 4);
  instances.setUsage(THREE.DynamicDrawUsage);
  geometry.setAttribute("chunk", instances);
  const mesh = new THREE.Mesh(geometry, ground);
  mesh.frustumCulled = false;
  const world = new THREE.Scene().add(mesh);
  const camera = new THREE.PerspectiveCamera(50, 1, 1, 1e6);
  camera.up.set(0, 0, 1);

  let frame = null;
  let splats = null;
  let means = null;
  let count = 0;
  const accumulate = pass(shaders.ACCUMULATE, { uFrame: { value: null }, uMean: { value: null }, uShare: { value: 1 } });
  const develop = pass(shaders.DEVELOP, { uFrame: { value: null }, uExposure: { value: 1 }, uToLuminance: { value: 1 }, uBalance: { value: new THREE.Matrix3() } });
  const meter = pass(shaders.METER, { uFrame: { value: null } });
  const meterTarget = target(...METER, THREE.FloatType, THREE.NearestFilter);

  const state = { scale: 1, ev: 15, bodies: [], height: NaN, cellPixels: software ? 2 : 1, hfov: 52, seenSide: 0, passes: 0, divider: 1, splats: null };

  function resize(width, height) {
    gl.setSize(width, height, false);
    frame?.dispose();
    means?.forEach((each) => each.dispose());
    frame = target(width, height, THREE.HalfFloatType, THREE.NearestFilter, { depthBuffer: true });
    means = [0, 1].map(() => target(width, height, THREE.FloatType, THREE.NearestFilter));
    count = 0;
  }

  /** The light of an instant. `bodies` are sun and moon; `quality` is the visibility's texels along the longer side. */
  function setLight(bodies, skyLight, scale, quality) {
    state.bodies = bodies;
    state.scale = scale;
    state.height = NaN;
    bodies.forEach((body, k) => {
      shared.uDirection.value[k].set(...body.direction);
      shared.uLight.value[k].set(...body.normal.map((value) => value * scale));
      shared.uRadius.value[k] = (body.radius * Math.PI) / 180;
      shared.uActive.value[k] = body.normal.some((value) => value > 0) && body.lights ? 1 : 0;
      if (!body.lights) shared.uLight.value[k].set(0, 0, 0);
      dome.uniforms.uDiscTo.value[k].set(...body.direction);
      const solid = 2 * Math.PI * (1 - Math.cos((body.radius * Math.PI) / 180));
      dome.uniforms.uDiscLight.value[k].set(...body.normal.map((value) => Math.min((value * scale) / solid, 1e9)));
      dome.uniforms.uDiscRadius.value[k] = (body.radius * Math.PI) / 180;
    });
    shared.uBody.value.set(...bodies[0].direction);
    dome.uniforms.uMoonSun.value.set(...bodies[0].trueDirection);
    for (let r = 0; r < rank; r++) shared.uSky.value[r].set(...[0, 1, 2].map((c) => skyLight.coefficients[3 * r + c] * scale));
    see(quality);
    relight();
  }

  /** Trace the visibility of the bodies; only when they moved. */
  function see(quality) {
    const longest = Math.max(terrain.columns, terrain.rows);
    const [width, height] = [terrain.columns, terrain.rows].map((each) => Math.max(2, Math.round((quality * each) / longest)));
    if (!seen || seen.width !== width || seen.height !== height) {
      seen?.dispose();
      seen = new THREE.WebGLRenderTarget(width, height, { type: THREE.UnsignedByteType, format: THREE.RGFormat, minFilter: THREE.LinearFilter, magFilter: THREE.LinearFilter, depthBuffer: false });
      shared.uSeen.value = seen.texture;
    }
    run(visibility, seen);
    state.seenSide = quality;
    state.passes += 1;
  }

  /** Light of clusters and ground; after the bodies or the albedo changed. */
  function relight() {
    if (!shared.uAlbedoA.value) return;
    run(clusterFirst, firstTarget);
    let radiance = firstTarget.textures[0];
    for (let k = 0; k < 3; k++) {
      clusterNext.uniforms.uRadiance.value = radiance;
      run(clusterNext, clusterTargets[k % 2]);
      radiance = clusterTargets[k % 2].texture;
    }
    bounce.uniforms.uRadiance.value = radiance;
    run(bounce, bounceTarget);
    run(diffuse, diffuseTarget);
    count = 0;
  }

  function setAlbedo(first, second, share) {
    shared.uAlbedoA.value = first;
    shared.uAlbedoB.value = second ?? first;
    shared.uGainA.value.set(...first.userData.gain);
    shared.uGainB.value.set(...(second ?? first).userData.gain);
    shared.uSeason.value = second ? share : 0;
    relight();
  }

  function albedoTexture(bitmap, gain) {
    const made = new THREE.Texture(bitmap);
    made.userData.gain = gain;
    made.colorSpace = THREE.SRGBColorSpace;
    made.flipY = false;
    made.generateMipmaps = true;
    made.minFilter = THREE.LinearMipmapLinearFilter;
    made.anisotropy = software ? 2 : 8;
    made.needsUpdate = true;
    return made;
  }

  /** Air and sky of the camera's height. */
  function setObserver(height) {
    const near = Number.isFinite(state.height) && Math.abs(height - state.height) < 20;
    if (near) return;
    state.height = height;
    const bodies = state.bodies.filter((body) => body.counts);
    const k = state.scale;
    const seenAir = light.air(bodies, height);
    fill(airTextures, seenAir.grid, k);
    const depthData = airTextures[3].image.data;
    for (let row = 0; row < airRows; row++) {
      for (let m = 0; m < columns; m++) {
        for (let a = 0; a < AIR_AZIMUTHS; a++) {
          for (let c = 0; c < 3; c++) depthData[((row * columns + m) * AIR_AZIMUTHS + a) * 4 + c] = half(seenAir.depth[(row * columns + m) * 3 + c]);
        }
      }
    }
    airTextures.forEach((each) => (each.needsUpdate = true));
    air.uHorizon.value = seenAir.horizon;
    const sky = light.sky(bodies, height);
    fill(skyTextures, sky.grid, k);
    skyTextures.forEach((each) => (each.needsUpdate = true));
    dome.uniforms.uHorizon.value = sky.horizon;
    for (let row = 0; row < 64; row++) {
      const colour = light.nightRadiance(90 - ((row + 0.5) * 180) / 64, height);
      for (let c = 0; c < 3; c++) nightTexture.image.data[row * 4 + c] = half(colour[c] * k);
    }
    nightTexture.needsUpdate = true;
  }

  function fill(textures, grid, scale) {
    const texels = grid.length / 10;
    for (let n = 0; n < texels; n++) {
      for (let part = 0; part < 3; part++) {
        for (let c = 0; c < 3; c++) textures[part].image.data[n * 4 + c] = half(grid[n * 10 + part * 3 + c] * scale);
      }
      textures[1].image.data[n * 4 + 3] = half(grid[n * 10 + 9]);
    }
  }

  function setCamera(position, forward, up, hfovDeg) {
    camera.position.set(...position);
    camera.up.set(...up);
    camera.lookAt(position[0] + forward[0], position[1] + forward[1], position[2] + forward[2]);
    state.hfov = hfovDeg;
    count = 0;
  }

  function project(jitter) {
    const [width, height] = [frame.width, frame.height];
    camera.aspect = width / height;
    camera.fov = (2 * Math.atan(Math.tan((state.hfov * Math.PI) / 360) / camera.aspect) * 180) / Math.PI;
    camera.near = 1;
    camera.far = 6 * Math.hypot(terrain.columns, terrain.rows) * terrain.step + 1e5;
    if (jitter) camera.setViewOffset(width, height, jitter[0], jitter[1], width, height);
    else camera.clearViewOffset();
    camera.updateProjectionMatrix();
    camera.updateMatrixWorld();
  }

  /** Draw one frame; `more` frames are averaged while nothing changes. Returns how many the picture holds. */
  function draw(height) {
    setObserver(height);
    const jitter = count === 0 ? [0, 0] : [halton(count, 2) - 0.5, halton(count, 3) - 0.5];
    project(jitter);
    dome.uniforms.uPixel.value = (2 * Math.tan((state.hfov * Math.PI) / 360)) / frame.width;
    const frustum = new THREE.Frustum().setFromProjectionMatrix(new THREE.Matrix4().multiplyMatrices(camera.projectionMatrix, camera.matrixWorldInverse));
    // Cells of some pixels: a chunk is divided while its cells look larger.
    const detail = 1 / (CELLS * state.cellPixels * dome.uniforms.uPixel.value);
    const chosen = chooseChunks(terrain, camera.position, detail, frustum).slice(0, MOST_CHUNKS);
    chosen.forEach((chunk, k) => instances.setXYZW(k, ...chunk));
    geometry.instanceCount = chosen.length;
    instances.needsUpdate = true;
    air.uEye.value.copy(camera.position);
    dome.uniforms.uRays.value.copy(camera.matrixWorld).setPosition(0, 0, 0).multiply(camera.projectionMatrixInverse);
    gl.setRenderTarget(frame);
    gl.clear(true, true, false);
    dome.depthTest = false;
    quad.material = dome;
    gl.render(flat, still);
    drawGround();
    count += 1;
    accumulate.uniforms.uFrame.value = frame.texture;
    accumulate.uniforms.uMean.value = means[count % 2].texture;
    accumulate.uniforms.uShare.value = 1 / count;
    run(accumulate, means[(count + 1) % 2]);
    state.mean = means[(count + 1) % 2];
    show();
    return count;
  }

  /** The mesh left of the divider, the Gaussians right of it. */
  function drawGround() {
    const [width, height] = [frame.width, frame.height];
    const left = splats ? Math.round(state.divider * width) : width;
    if (left === width) return gl.render(world, camera);
    frame.scissorTest = true;
    frame.scissor.set(0, 0, left, height);
    gl.setRenderTarget(frame);
    if (left > 0) gl.render(world, camera);
    frame.scissor.set(left, 0, width - left, height);
    splats.draw(camera, frame, state.scale);
    frame.scissorTest = false;
  }

  /** Draw a model of `makeGaussians` right of the divider. */
  function setGaussians(model) {
    splats = makeSplats(gl, model, air, { texture, target, pass, run });
    state.splats = splats;
  }

  function show() {
    if (!state.mean) return;
    develop.uniforms.uFrame.value = state.mean.texture;
    develop.uniforms.uToLuminance.value = 1 / state.scale;
    develop.uniforms.uExposure.value = GAIN / (state.scale * SATURATION * 2 ** state.ev);
    run(develop, null);
  }

  function setExposure(ev, white) {
    state.ev = ev;
    develop.uniforms.uBalance.value.set(...balance(white).flat());
  }

  /** Luminances [cd/m²] of a coarse copy of the picture, for metering. */
  function luminances() {
    meter.uniforms.uFrame.value = state.mean.texture;
    run(meter, meterTarget);
    const pixels = new Float32Array(METER[0] * METER[1] * 4);
    gl.readRenderTargetPixels(meterTarget, 0, 0, ...METER, pixels);
    const list = [];
    for (let k = 0; k < pixels.length; k += 4) list.push((0.212639 * pixels[k] + 0.7151687 * pixels[k + 1] + 0.0721923 * pixels[k + 2]) / state.scale);
    return list;
  }

  /** Radiance [cd/m²] of the picture, rows from the bottom: for measurements. */
  function readRadiance() {
    const { width, height } = state.mean;
    const pixels = new Float32Array(width * height * 4);
    gl.readRenderTargetPixels(state.mean, 0, 0, width, height, pixels);
    return { width, height, pixels: pixels.map((value) => value / state.scale) };
  }

  function mark(point, pixels) {
    ground.uniforms.uMark.value = point ? (pixels * 2 * Math.tan((state.hfov * Math.PI) / 360)) / frame.width / terrain.step : 0;
    if (point) ground.uniforms.uMarkAt.value.set((point[0] - terrain.west) / (terrain.step * (terrain.columns - 1)), (point[1] - terrain.south) / (terrain.step * (terrain.rows - 1)));
    count = 0;
  }

  /** The direction through a point of the picture, in [-1, 1] from left and bottom. */
  function ray(x, y) {
    project(null);
    const d = new THREE.Vector3(x, y, 0.5).unproject(camera).sub(camera.position).normalize();
    return [d.x, d.y, d.z];
  }

  return {
    gl, state, software, device, resize, setLight, setAlbedo, albedoTexture, setCamera, draw, show, setExposure, luminances, readRadiance, mark, ray, see, relight, setGaussians,
    ground, diffuse, shared,
    reset: () => (count = 0),
    finish: () => context.finish(),
  };
}

/** (N, L) values as layers of four: (L / 4, texels, 4); texels beyond N are zero. */
function byLayers(data, count, length, texels = count) {
  const result = new data.constructor(texels * length);
  for (let n = 0; n < count; n++) {
    for (let l = 0; l < length; l++) result[((l >> 2) * texels + n) * 4 + (l & 3)] = data[n * length + l];
  }
  return result;
}

function halton(index, base) {
  let [result, f] = [0, 1];
  for (let k = index; k > 0; k = Math.floor(k / base)) {
    f /= base;
    result += f * (k % base);
  }
  return result;
}

const multiply = (a, b) => a.map((row) => b[0].map((_, c) => row.reduce((sum, value, k) => sum + value * b[k][c], 0)));

/** Matrix that makes a colour neutral, by Bradford's adaptation. */
function balance(white) {
  const cones = multiply(BRADFORD, XYZ);
  const sum = (v) => cones.map((row) => row.reduce((total, value, k) => total + value * v[k], 0));
  const gains = sum([1, 1, 1]).map((value, k) => value / sum(white)[k]);
  const inverse = new THREE.Matrix3().set(...cones.flat()).invert().toArray();
  const rows = [0, 1, 2].map((r) => [0, 1, 2].map((c) => inverse[c * 3 + r]));
  return multiply(rows, cones.map((row, k) => row.map((value) => value * gains[k])));
}
