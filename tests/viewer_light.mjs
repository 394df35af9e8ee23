// The page's own light at instants and directions, for tests/test_viewer.py: node viewer_light.mjs FOLDER QUESTIONS.json
import { readFile } from "node:fs/promises";
import { makeLight } from "../viewer/src/light.js";
import { angles, makeFrame } from "../viewer/src/frames.js";
import { unpack } from "../viewer/src/arrays.js";

const [folder, file] = process.argv.slice(2);
const about = JSON.parse(await readFile(`${folder}/scene.json`, "utf8"));
const binary = await readFile(`${folder}/scene.bin`);
const buffer = binary.buffer.slice(binary.byteOffset, binary.byteOffset + binary.length);
const arrays = Object.fromEntries(Object.entries(about.arrays).map(([name, entry]) => [name, unpack(buffer, entry)]));
const light = makeLight(arrays, about);
const frame = makeFrame(about.frame);
const questions = JSON.parse(await readFile(file, "utf8"));
const answers = questions.suns.map(({ azimuth, elevation, direction, distance }) => {
  const near = 1 / distance ** 2;
  const bodies = [{ azimuth, elevation, direction, colour: [near, near, near] }];
  const sky = light.sky(bodies, questions.height_m);
  return {
    direct: light.direct(elevation).map((value) => value * near),
    level: light.skyCoefficients(bodies).level,
    sky: questions.directions.map((d) => light.skyRadiance(sky, d, direction, questions.height_m)),
    night: questions.directions.map((d) => light.nightRadiance(angles(d)[1], questions.height_m)),
  };
});
const positions = questions.geodetic.map((place) => frame.fromGeodetic(...place));
const back = positions.map((position) => frame.toGeodetic(position));
const axes = questions.geodetic.map(([latitude, longitude]) => frame.localAxes(latitude, longitude));
console.log(JSON.stringify({ answers, positions, back, axes }));
