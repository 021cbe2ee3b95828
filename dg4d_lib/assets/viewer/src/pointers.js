// KHR_animation_pointer for KHR_texture_transform of base color textures, which animates textures per frame.

const POINTER =
  /^\/materials\/(\d+)\/pbrMetallicRoughness\/baseColorTexture\/extensions\/KHR_texture_transform\/(offset|scale|rotation)$/;

/** Returns the pointer tracks of a glTF's first animation, which three.js ignores. */
export async function pointersOf(gltf) {
  const { json } = gltf.parser;
  const animation = json.animations?.[0] ?? { channels: [] };
  const tracks = animation.channels.map(async ({ sampler, target }) => {
    const match = POINTER.exec(target.extensions?.KHR_animation_pointer?.pointer ?? "");
    if (!match) return null;
    const { input, output, interpolation } = animation.samplers[sampler];
    const [times, values] = await Promise.all([input, output].map((i) => gltf.parser.getDependency("accessor", i)));
    return { material: Number(match[1]), property: match[2], times: times.array, values: values.array, step: interpolation === "STEP" };
  });
  return new Pointers(gltf.parser, (await Promise.all(tracks)).filter(Boolean));
}

class Pointers {
  constructor(parser, tracks) {
    this.parser = parser;
    this.tracks = tracks;
    this.duration = Math.max(0, ...tracks.map(({ times }) => times.at(-1)));
    this.textures = []; // of every track, those that it moves
  }

  /** Finds the textures to move: `shown[i]` stands for the material `loaded[i]`. */
  connect(loaded, shown) {
    const numbers = loaded.map((material) => this.parser.associations.get(material)?.materials);
    this.textures = this.tracks.map(({ material }) =>
      shown.filter(({ map }, i) => map && numbers[i] === material).map(({ map }) => map),
    );
  }

  seek(time) {
    this.tracks.forEach((track, i) => {
      const value = sample(track, time);
      for (const texture of this.textures[i]) {
        if (track.property === "rotation") [texture.rotation] = value;
        else texture[track.property === "scale" ? "repeat" : "offset"].fromArray(value);
      }
    });
  }
}

/** Evaluates a STEP or LINEAR track at a time. */
function sample({ times, values, step }, time) {
  const width = values.length / times.length;
  const row = (key) => Array.from(values.subarray(key * width, (key + 1) * width));
  let after = times.findIndex((key) => key > time);
  if (after < 0) after = times.length;
  const before = Math.max(0, after - 1);
  if (step || after === 0 || after === times.length) return row(before);
  const share = (time - times[before]) / (times[after] - times[before]);
  const end = row(after);
  return row(before).map((value, i) => value + share * (end[i] - value));
}
