// GLSL ES 3.00 of the page's passes.

export const FULL_SCREEN = /* glsl */ `
in vec3 position;
out vec2 vUv;
void main() { vUv = 0.5 * position.xy + 0.5; gl_Position = vec4(position.xy, 0.0, 1.0); }
`;

const PRECISION = /* glsl */ `
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler3D;
precision highp sampler2DArray;
precision highp usampler2DArray;
const float PI = 3.14159265358979;
`;

/** Fraction of a disc above a straight horizon: `x` is the horizon's height over the disc's centre, in radii. */
const DISC = /* glsl */ `
float discAbove(float x) {
  x = clamp(x, -1.0, 1.0);
  return 0.5 - (asin(x) + x * sqrt(max(1.0 - x * x, 0.0))) / PI;
}
`;

// One ray for each texel along the azimuth of the body, over the greatest heights of ever larger blocks of cells. What it
// keeps is the highest tangent of elevation that the ground reaches.
export const VISIBILITY = PRECISION + DISC + /* glsl */ `
uniform sampler2D uHeight, uMost, uSlope;
uniform ivec2 uNodes;
uniform float uStep;
uniform int uLevels;
uniform vec3 uDirection[2];
uniform float uRadius[2];
uniform int uActive[2];
in vec2 vUv;
out vec4 colour;

float heightAt(vec2 node) {
  vec2 p = clamp(node, vec2(0.0), vec2(uNodes - 1) - 0.001);
  ivec2 i = ivec2(p);
  vec2 f = p - vec2(i);
  float a = texelFetch(uHeight, i, 0).r, b = texelFetch(uHeight, i + ivec2(1, 0), 0).r;
  float c = texelFetch(uHeight, i + ivec2(0, 1), 0).r, d = texelFetch(uHeight, i + ivec2(1, 1), 0).r;
  return mix(mix(a, b, f.x), mix(c, d, f.x), f.y);
}

float horizon(vec2 start, float h0, vec2 towards, float lowest, float highest) {
  float tangent = lowest;
  float t = 0.35;
  int level = 0;
  vec2 inverse = 1.0 / (abs(towards) + 1e-9);
  for (int k = 0; k < 3000; k++) {
    vec2 p = start + towards * t;
    if (p.x < 0.0 || p.y < 0.0 || p.x >= float(uNodes.x - 1) || p.y >= float(uNodes.y - 1) || tangent > highest) break;
    int size = 1 << level;
    ivec2 cell = ivec2(p) >> level;
    vec2 low = vec2(cell * size);
    vec2 room = mix(p - low, low + float(size) - p, step(0.0, towards)) * inverse;
    float leave = min(room.x, room.y) + 1e-3;
    float most = texelFetch(uMost, cell, level).r;
    if (most - h0 <= tangent * t * uStep) {
      t += leave;
      if (level < uLevels - 1) level++;
    } else if (level > 0) {
      level--;
    } else {
      float middle = t + 0.5 * leave, last = t + leave;
      tangent = max(tangent, (heightAt(start + towards * middle) - h0) / (middle * uStep));
      tangent = max(tangent, (heightAt(start + towards * last) - h0) / (last * uStep));
      t = last;
    }
  }
  return tangent;
}

void main() {
  vec2 node = vUv * vec2(uNodes - 1);
  float h0 = heightAt(node);
  vec2 slope = texture(uSlope, (node + 0.5) / vec2(uNodes)).xy;
  vec3 normal = normalize(vec3(-slope, 1.0));
  vec2 seen = vec2(0.0);
  for (int body = 0; body < 2; body++) {
    vec3 d = uDirection[body];
    float across = length(d.xy);
    if (uActive[body] == 0 || dot(normal, d) <= -0.01) continue;
    float centre = atan(d.z, across), radius = uRadius[body];
    float low = tan(centre - radius), high = tan(min(centre + radius, 1.55));
    if (centre > 1.5) { seen[body] = 1.0; continue; }
    float tangent = horizon(node, h0 + 0.02 * uStep, d.xy / across, low, high);
    seen[body] = tangent <= low ? 1.0 : discAbove((atan(tangent) - centre) / radius);
  }
  colour = vec4(seen, 0.0, 1.0);
}
`;

const SURFACE = /* glsl */ `
uniform sampler2D uSlope, uSeen, uAlbedoA, uAlbedoB, uOrder;
uniform ivec2 uNodes;
uniform float uSeason, uOrderLow, uOrderHigh;
uniform vec3 uGainA, uGainB;
uniform vec3 uDirection[2];
uniform vec3 uLight[2];

vec3 normalAt(vec2 uv) {
  vec2 slope = texture(uSlope, (uv * vec2(uNodes - 1) + 0.5) / vec2(uNodes)).xy;
  return normalize(vec3(-slope, 1.0));
}

vec3 albedoAt(vec2 uv, float bias) {
  vec3 a = uGainA * texture(uAlbedoA, uv, bias).rgb;
  if (uSeason <= 0.0) return a;
  vec3 b = uGainB * texture(uAlbedoB, uv, bias).rgb;
  float change = abs(dot(b - a, vec3(0.2126, 0.7152, 0.0722)));
  float order = (texture(uOrder, uv).r - uOrderLow) / max(uOrderHigh - uOrderLow, 1e-3);
  float when = dot(b - a, vec3(1.0)) < 0.0 ? order : 1.0 - order;
  float line = clamp((uSeason - mix(0.1, 0.9, clamp(when, 0.0, 1.0))) / 0.2 + 0.5, 0.0, 1.0);
  return mix(a, b, mix(uSeason, line, smoothstep(0.08, 0.25, change)));
}

/** Irradiance of sun and moon over pi. */
vec3 directAt(vec2 uv, vec3 normal, vec2 seen) {
  return (uLight[0] * (seen.x * max(dot(normal, uDirection[0]), 0.0)) +
          uLight[1] * (seen.y * max(dot(normal, uDirection[1]), 0.0))) / PI;
}
`;

// Radiance of the clusters before further reflections: their four points lit by sun, moon and sky.
export const CLUSTER_FIRST = PRECISION + SURFACE + /* glsl */ `
uniform highp usampler2DArray uPoints;
uniform sampler2DArray uLevels;
uniform vec3 uSky[16];
uniform vec2 uRange[16];
uniform int uRank;
layout(location = 0) out vec4 first;
layout(location = 1) out vec4 reflectance;
in vec2 vUv;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 sunlit = vec3(0.0), albedo = vec3(0.0);
  for (int k = 0; k < 4; k++) {
    vec2 uv = vec2(texelFetch(uPoints, ivec3(at, k), 0).rg) / 65535.0;
    vec3 own = albedoAt(uv, 2.0);
    sunlit += 0.25 * own * directAt(uv, normalAt(uv), texture(uSeen, uv).rg);
    albedo += 0.25 * own;
  }
  vec3 sky = vec3(0.0);
  for (int r = 0; r < uRank; r++) {
    float level = texelFetch(uLevels, ivec3(at, r / 4), 0)[r % 4];
    sky += mix(uRange[r].x, uRange[r].y, level) * uSky[r];
  }
  first = vec4(sunlit + albedo * max(sky, 0.0), 1.0);
  reflectance = vec4(albedo, 1.0);
}
`;

const GATHER = /* glsl */ `
uniform highp usampler2DArray uLists;
uniform sampler2D uShare, uRadiance;
uniform int uLayers, uSide;
vec3 gathered(ivec2 at) {
  vec3 total = vec3(0.0);
  for (int layer = 0; layer < uLayers; layer++) {
    uvec4 list = texelFetch(uLists, ivec3(at, layer), 0);
    for (int k = 0; k < 4; k++) {
      int index = int(list[k]);
      total += texelFetch(uRadiance, ivec2(index % uSide, index / uSide), 0).rgb;
    }
  }
  return total * (texelFetch(uShare, at, 0).r / float(4 * uLayers));
}
`;

export const CLUSTER_NEXT = PRECISION + GATHER + /* glsl */ `
uniform sampler2D uFirst, uReflectance;
out vec4 colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  colour = vec4(texelFetch(uFirst, at, 0).rgb + texelFetch(uReflectance, at, 0).rgb * gathered(at), 1.0);
}
`;

export const BOUNCE = PRECISION + GATHER + /* glsl */ `
out vec4 colour;
void main() { colour = vec4(gathered(ivec2(gl_FragCoord.xy)), 1.0); }
`;

// Irradiance over pi from sky and other ground. Reflected light is averaged over neighbours: each saw a few clusters.
export const DIFFUSE = PRECISION + /* glsl */ `
uniform sampler2DArray uLevels;
uniform sampler2D uBounce;
uniform vec3 uSky[16];
uniform vec2 uRange[16];
uniform int uRank;
uniform float uBounceScale;
in vec2 vUv;
out vec4 colour;
void main() {
  vec3 sky = vec3(0.0);
  for (int r = 0; r < uRank; r++) {
    float level = texelFetch(uLevels, ivec3(ivec2(gl_FragCoord.xy), r / 4), 0)[r % 4];
    sky += mix(uRange[r].x, uRange[r].y, level) * uSky[r];
  }
  vec2 texel = 1.0 / vec2(textureSize(uBounce, 0));
  vec3 bounce = vec3(0.0);
  for (int y = -1; y <= 1; y++) {
    for (int x = -1; x <= 1; x++) {
      float weight = (x == 0 ? 0.5 : 0.25) * (y == 0 ? 0.5 : 0.25);
      bounce += weight * texture(uBounce, vUv + vec2(x, y) * texel).rgb;
    }
  }
  colour = vec4(max(sky, 0.0) + uBounceScale * bounce, 1.0);
}
`;

const PHASES = /* glsl */ `
uniform sampler2D uPhase;
uniform vec3 uAerosol;
uniform float uGamma;
uniform vec3 uBody;
uniform float uHorizon;
float rowOf(float elevation, float below, float above) {
  if (elevation >= uHorizon) {
    return below + pow(min((elevation - uHorizon) / (0.5 * PI - uHorizon), 1.0), 1.0 / 2.5) * (above - 1.0);
  }
  return (1.0 - pow(min((uHorizon - elevation) / (0.5 * PI + uHorizon), 1.0), 1.0 / 3.0)) * (below - 1.0);
}
vec3 scattered(vec3 gas, vec4 aerosol, vec3 other, vec3 d) {
  // Chord length: the angle from the cosine has no digits near the body.
  float angle = 2.0 * asin(clamp(0.5 * length(d - uBody), 0.0, 1.0));
  float cosine = cos(angle);
  float rayleigh = 3.0 / (16.0 * PI * (1.0 + 2.0 * uGamma)) * (1.0 + 3.0 * uGamma + (1.0 - uGamma) * cosine * cosine);
  vec2 size = vec2(textureSize(uPhase, 0));
  float x = sqrt(angle / PI);
  vec3 depth = sqrt(clamp(aerosol.a * uAerosol / 6.0, 0.0, 1.0));
  vec3 phase;
  for (int k = 0; k < 3; k++) phase[k] = texture(uPhase, (vec2(x, depth[k]) * (size - 1.0) + 0.5) / size).r;
  return gas * rayleigh + aerosol.rgb * phase + other;
}
`;

export const TERRAIN_VERTEX = PRECISION + /* glsl */ `
in vec3 position;
in vec4 chunk;
uniform sampler2D uHeight;
uniform sampler2DArray uTileHeight;
uniform vec3 uTile[48];
uniform ivec2 uNodes;
uniform vec2 uWest;
uniform float uStep;
uniform mat4 projectionMatrix, viewMatrix;
out vec2 vUvGround;
out vec3 vWorld;
flat out int vSlot;
void main() {
  vec2 node = min(chunk.xy + position.xy * chunk.z, vec2(uNodes - 1));
  vSlot = int(chunk.w);
  float height;
  if (vSlot >= 0) {
    vec3 tile = uTile[vSlot];
    height = texelFetch(uTileHeight, ivec3(ivec2((node - tile.xy) * tile.z + 1.5), vSlot), 0).r;
  } else height = texelFetch(uHeight, ivec2(node), 0).r;
  vUvGround = node / vec2(uNodes - 1);
  // Skirts hide the seams between chunks of different steps.
  vWorld = vec3(uWest + node * uStep, height - position.z * chunk.z * uStep * 1.5);
  gl_Position = projectionMatrix * viewMatrix * vec4(vWorld, 1.0);
}
`;

// What the air takes from a surface's radiance, and adds to it.
const AIR = /* glsl */ `
uniform sampler3D uAirGas, uAirAerosol, uAirOther, uAirDepth;
uniform vec3 uEye, uHazeShare;
uniform float uHaze, uAirOn;
uniform float uDistances[16];
uniform int uColumns;
uniform vec2 uAirRows;
vec3 throughAir(vec3 radiance, vec3 ray, float distance) {
  vec3 d = ray / distance;
  float most = uDistances[uColumns - 1], reached = min(distance, most);
  int c = 0;
  for (int k = 1; k < 15; k++) if (k < uColumns - 1 && uDistances[k] < reached) c = k;
  float column = float(c) + (reached - uDistances[c]) / (uDistances[c + 1] - uDistances[c]);
  float row = rowOf(asin(clamp(d.z, -1.0, 1.0)), uAirRows.x, uAirRows.y);
  vec3 size = vec3(textureSize(uAirGas, 0));
  vec3 at = vec3(atan(d.x, d.y) / (2.0 * PI) + 0.5 / size.x, (column + 0.5) / size.y, (row + 0.5) / size.z);
  vec3 depth = texture(uAirDepth, at).rgb * (distance / reached);
  vec3 light = max(scattered(texture(uAirGas, at).rgb, texture(uAirAerosol, at), texture(uAirOther, at).rgb, d), 0.0);
  vec3 plain = exp(-depth);
  vec3 through = exp(-depth * (1.0 + (uHaze - 1.0) * uHazeShare));
  light *= (1.0 - through) / max(1.0 - plain, 1e-5);
  return mix(radiance, radiance * through + light, uAirOn);
}
`;

export const TERRAIN = PRECISION + SURFACE + PHASES + AIR + /* glsl */ `
uniform sampler2D uDiffuse, uMask;
uniform sampler2DArray uTileSlope;
uniform vec3 uTile[48];
uniform float uShadows, uMark;
uniform vec2 uMarkAt;
in vec2 vUvGround;
in vec3 vWorld;
flat in int vSlot;
layout(location = 0) out vec4 colour;
void main() {
  if (texture(uMask, vUvGround).r < 0.5) discard;
  vec3 normal = normalAt(vUvGround);
  if (vSlot >= 0) {
    vec2 at = ((vUvGround * vec2(uNodes - 1) - uTile[vSlot].xy) * uTile[vSlot].z + 1.5) / vec2(textureSize(uTileSlope, 0).xy);
    normal = normalize(vec3(-texture(uTileSlope, vec3(at, float(vSlot))).xy, 1.0));
  }
  vec2 seen = mix(vec2(1.0), texture(uSeen, vUvGround).rg, uShadows);
  vec3 irradiance = directAt(vUvGround, normal, seen) + texture(uDiffuse, vUvGround).rgb;
  vec3 ray = vWorld - uEye;
  float distance = length(ray);
  vec3 radiance = throughAir(albedoAt(vUvGround, 0.0) * irradiance, ray, distance);
  if (uMark > 0.0) {
    float ring = length((vUvGround - uMarkAt) * vec2(uNodes - 1)) / (uMark * distance);
    if (abs(ring - 1.0) < 0.22) radiance = vec3(0.9, 0.25, 0.05);
  }
  colour = vec4(min(radiance, 60000.0), 1.0);
}
`;

// Gaussians as seasonscapes/rendering/splatting.py: the ellipse of each in the picture, blended from the back.
export const SPLAT_VERTEX = PRECISION + PHASES + AIR + /* glsl */ `
in vec3 position;
in float which;
uniform sampler2D uCentre, uAxes, uColour;
uniform int uAcross;
uniform float uFocal, uVariance, uCut;
uniform vec2 uPicture;
uniform mat4 projectionMatrix, viewMatrix;
out vec2 vOff;
out vec4 vLight;
flat out vec3 vConic;
void main() {
  int number = int(which);
  ivec2 at = ivec2(number % uAcross, number / uAcross);
  vec4 centre = texelFetch(uCentre, at, 0);
  vec3 ray = centre.xyz - uEye;
  vec3 p = (viewMatrix * vec4(centre.xyz, 1.0)).xyz;
  float depth = -p.z;
  gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  vec3 axis[3];
  for (int k = 0; k < 3; k++) axis[k] = texelFetch(uAxes, ivec2(3 * at.x + k, at.y), 0).xyz;
  if (depth <= 1.0 || centre.w < uCut || dot(ray, axis[2]) >= 0.0) return;
  vec2 slope = clamp(p.xy / depth, -0.65 * uPicture / uFocal, 0.65 * uPicture / uFocal);
  float xx = uVariance, xy = 0.0, yy = uVariance;
  for (int k = 0; k < 3; k++) {
    vec3 a = mat3(viewMatrix) * axis[k];
    vec2 m = uFocal / depth * (a.xy + slope * a.z);
    xx += m.x * m.x; xy += m.x * m.y; yy += m.y * m.y;
  }
  float determinant = max(xx * yy - xy * xy, 1e-12);
  vConic = vec3(yy, -xy, xx) / determinant;
  vOff = position.xy * sqrt(2.0 * log(centre.w / uCut)) * sqrt(vec2(xx, yy));
  vLight = vec4(min(throughAir(texelFetch(uColour, at, 0).rgb, ray, length(ray)), 60000.0), centre.w);
  vec4 clip = projectionMatrix * vec4(p, 1.0);
  gl_Position = clip + vec4(2.0 * vOff / uPicture * clip.w, 0.0, 0.0);
}
`;

export const SPLAT = PRECISION + /* glsl */ `
uniform float uCut, uMost;
in vec2 vOff;
in vec4 vLight;
flat in vec3 vConic;
layout(location = 0) out vec4 colour;
void main() {
  float power = -0.5 * (vConic.x * vOff.x * vOff.x + vConic.z * vOff.y * vOff.y) - vConic.y * vOff.x * vOff.y;
  float alpha = min(vLight.a * exp(power), uMost);
  if (alpha < uCut) discard;
  colour = vec4(vLight.rgb * alpha, alpha);
}
`;

// Neighbouring discs leave gaps of a few per cent, through which the sky must not shine.
export const SPLAT_OVER = PRECISION + /* glsl */ `
uniform sampler2D uFrame;
uniform float uFull;
out vec4 colour;
void main() {
  vec4 drawn = texelFetch(uFrame, ivec2(gl_FragCoord.xy), 0);
  float solid = clamp(drawn.a / uFull, 0.0, 1.0);
  colour = vec4(drawn.rgb / max(drawn.a, 1e-6) * solid, solid);
}
`;

export const SKY = PRECISION + PHASES + /* glsl */ `
uniform sampler2D uSkyGas, uSkyAerosol, uSkyOther, uNight;
uniform mat4 uRays;
uniform vec3 uDiscTo[2];
uniform vec3 uDiscLight[2];
uniform float uDiscRadius[2];
uniform float uPixel, uMoonLit;
uniform vec3 uMoonSun;
uniform vec2 uSkyRows;
in vec2 vUv;
layout(location = 0) out vec4 colour;
void main() {
  vec4 far = uRays * vec4(2.0 * vUv - 1.0, 1.0, 1.0);
  vec3 d = normalize(far.xyz / far.w);
  float elevation = asin(clamp(d.z, -1.0, 1.0));
  vec2 size = vec2(textureSize(uSkyGas, 0));
  vec2 at = vec2(atan(d.x, d.y) / (2.0 * PI) + 0.5 / size.x, (rowOf(elevation, uSkyRows.x, uSkyRows.y) + 0.5) / size.y);
  vec3 sky = scattered(texture(uSkyGas, at).rgb, texture(uSkyAerosol, at), texture(uSkyOther, at).rgb, d);
  // The night's background as from 4 degrees up, fading below the horizon.
  float lifted = max(elevation, 4.0 * PI / 180.0);
  float fade = clamp(1.0 + elevation * 180.0 / PI / 2.0, 0.0, 1.0);
  sky = max(sky, 0.0) + fade * texture(uNight, vec2(0.5, 0.5 - lifted / PI)).rgb;
  for (int k = 0; k < 2; k++) {
    float angle = length(d - uDiscTo[k]);
    float inside = clamp((uDiscRadius[k] - angle) / uPixel + 0.5, 0.0, 1.0);
    if (k == 1 && inside > 0.0) {
      // The moon's sphere, lit from the sun's side.
      vec3 off = (d - uDiscTo[1] * dot(d, uDiscTo[1])) / uDiscRadius[1];
      vec3 n = off - uDiscTo[1] * sqrt(max(1.0 - dot(off, off), 0.0));
      inside *= smoothstep(-0.03, 0.03, dot(n, uMoonSun));
    }
    sky += inside * uDiscLight[k];
  }
  colour = vec4(min(sky, 60000.0), 1.0);
}
`;

export const ACCUMULATE = PRECISION + /* glsl */ `
uniform sampler2D uFrame, uMean;
uniform float uShare;
out vec4 colour;
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  colour = mix(texelFetch(uMean, at, 0), texelFetch(uFrame, at, 0), uShare);
}
`;

export const METER = PRECISION + /* glsl */ `
uniform sampler2D uFrame;
in vec2 vUv;
out vec4 colour;
void main() { colour = vec4(texture(uFrame, vUv).rgb, 1.0); }
`;

// Exposure and look of seasonscapes/exposure.py and photo_look.py; the frame holds radiance times uFrameScale.
export const DEVELOP = PRECISION + /* glsl */ `
uniform sampler2D uFrame;
uniform float uExposure, uToLuminance;
uniform mat3 uBalance;
out vec4 colour;
const vec3 LUMINANCE = vec3(0.2126390, 0.7151687, 0.0721923);
const float CONTRAST = 1.6, PER_CHANNEL = 0.6, GREY = 0.18;
float curve(float value) {
  float power = pow(value, CONTRAST);
  return power / (power + pow(GREY, CONTRAST) * (1.0 / GREY - 1.0));
}
void main() {
  vec3 light = max(texelFetch(uFrame, ivec2(gl_FragCoord.xy), 0).rgb, 0.0);
  float bright = max(dot(light, LUMINANCE) * uToLuminance, 1e-9);
  const float LOW = -3.3979400, HIGH = -1.6989700;
  float rods = clamp((HIGH - log(bright) / 2.302585) / (HIGH - LOW), 0.0, 1.0);
  vec3 tint = vec3(0.62, 0.80, 1.35) / dot(vec3(0.62, 0.80, 1.35), LUMINANCE);
  light = mix(light, max(dot(light, vec3(0.0627, 0.6072, 0.3301)), 0.0) * tint, rods);
  light = max(uBalance * light, 0.0) * uExposure;
  float peak = max(light.r, max(light.g, light.b));
  vec3 shown = PER_CHANNEL * vec3(curve(light.r), curve(light.g), curve(light.b)) +
    (1.0 - PER_CHANNEL) * light * (curve(peak) / max(peak, 1e-12));
  vec3 encoded = mix(12.92 * shown, 1.055 * pow(shown, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, shown));
  colour = vec4(encoded, 1.0);
}
`;
