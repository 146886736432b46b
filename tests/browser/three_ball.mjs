// Draws a lit ball with three.js.
//
// The job holds what the ball is made of and how it is lit:
//   material   MeshPhongMaterial JSON, loaded with THREE.MaterialLoader; or gltf, loaded with GLTFLoader
//   exact      take the colours from userData.linear instead of the 8-bit ones
//   direction  towards the light; intensity and ambient as three.js counts them, RGB each
//   size       pixels on a side; width of the picture in units of the ball's radius
// The picture is size x size x 3 float32, linear, row 0 at the top. Answers what the loader made of the material.

import { readFileSync, writeFileSync } from "node:fs";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const modules = join(dirname(fileURLToPath(import.meta.url)), "node_modules");
const page_text = `<script type="importmap">{"imports": {"three": "/three/build/three.module.js",
  "three/addons/": "/three/examples/jsm/"}}</script>`;

export default async function (browser, job, picture) {
  const page = await browser.newPage();
  page.on("pageerror", (error) => { throw error; });
  await page.route("**/*", (route) => {
    const path = new URL(route.request().url()).pathname;
    if (path === "/") return route.fulfill({ contentType: "text/html", body: page_text });
    return route.fulfill({ contentType: "text/javascript", body: readFileSync(join(modules, path)) });
  });
  await page.goto("http://ball.test/");
  const result = await page.evaluate(async (job) => {
    const THREE = await import("three");
    const { GLTFLoader } = await import("three/addons/loaders/GLTFLoader.js");
    let material;
    if (job.gltf) {
      const loaded = await new GLTFLoader().parseAsync(JSON.stringify(job.gltf), "");
      material = await loaded.parser.getDependency("material", 0);
    } else {
      material = new THREE.MaterialLoader().parse(job.material);
    }
    if (job.exact) {
      for (const [key, value] of Object.entries(material.userData.linear)) material[key].setRGB(...value);
    }
    const scene = new THREE.Scene();
    scene.add(new THREE.Mesh(new THREE.SphereGeometry(1, 1024, 512), material));
    const light = new THREE.DirectionalLight();
    light.color.setRGB(...job.intensity);
    light.position.set(...job.direction);
    scene.add(light);
    const ambient = new THREE.AmbientLight();
    ambient.color.setRGB(...job.ambient);
    scene.add(ambient);
    const half = job.width / 2;
    const camera = new THREE.OrthographicCamera(-half, half, half, -half, 0.1, 10);
    camera.position.z = 4;
    const renderer = new THREE.WebGLRenderer();
    const target = new THREE.WebGLRenderTarget(job.size, job.size, { type: THREE.FloatType });
    renderer.setRenderTarget(target);
    renderer.render(scene, camera);
    const pixels = new Float32Array(4 * job.size * job.size);
    renderer.readRenderTargetPixels(target, 0, 0, job.size, job.size, pixels);
    const words = material.toJSON();
    return { pixels: Array.from(pixels), words, revision: THREE.REVISION };
  }, job);
  const size = job.size;
  const flipped = new Float32Array(3 * size * size);
  for (let row = 0; row < size; row++) {
    for (let column = 0; column < size; column++) {
      for (let channel = 0; channel < 3; channel++) {
        flipped[3 * (row * size + column) + channel] =
          result.pixels[4 * ((size - 1 - row) * size + column) + channel];
      }
    }
  }
  writeFileSync(picture, Buffer.from(flipped.buffer));
  return { material: result.words, revision: result.revision };
}
