// What the page needs of three.js. three.bundle.js is made from this file, and committed, so that the page works
// without a network and an installation without npm:
//
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three.entry.js --bundle --format=esm --minify --legal-comments=none \
//     '--banner:js=/* three.js 0.187.0, MIT License, see three.license.txt */' --outfile=three.bundle.js
//
// in a folder that holds this file. three.license.txt is three.js's own LICENSE.

export {
  BufferAttribute, BufferGeometry, CatmullRomCurve3, Color, DirectionalLight, DoubleSide, DynamicDrawUsage, Group,
  HemisphereLight, LineBasicMaterial, LineSegments, Mesh, MeshPhysicalMaterial, MeshStandardMaterial,
  PerspectiveCamera, Scene, SphereGeometry, TubeGeometry, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
