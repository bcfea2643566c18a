// Bundles the page into the Python package: three files that ask for nothing else.
import { build } from "esbuild";
import { copyFile } from "node:fs/promises";

const out = process.argv[2] ?? "../stackgen/assets/studio";
await build({
  entryPoints: { studio: "src/main.ts" },
  outdir: out,
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "inline",
});
for (const file of ["index.html", "studio.css"]) await copyFile(file, `${out}/${file}`);
