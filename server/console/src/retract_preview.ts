/** What a retract would change, in the map: what goes in red, before anything is taken out. */

import type { Api } from "./api.ts";
import { voxelSizeOf } from "./map_layers.ts";
import type { MapInfo, RetractRequest, Triple } from "./messages.ts";
import { ChangedVoxels } from "./scene/changed_voxels.ts";
import type { Stage } from "./scene/stage.ts";
import { isShown } from "./scene/viewpoint.ts";
import { counted } from "./units.ts";

/** Okabe and Ito's, and what each is in words. */
const WAYS = {
  gone: ["#d55e00", "red: goes"], appeared: ["#009e73", "green: comes back"], warmer: ["#f0e442", "yellow: warmer then"], colder: ["#56b4e9", "blue: colder then"],
  otherwise: ["#cc79a7", "pink: looks different"],
} as const;
type Way = keyof typeof WAYS;

/** Answer to POST .../main/changes: PROTOCOL.md section 4.14. */
type RetractChanges = { commits: number; counts: Record<Way, number> } & Record<Way, { centres_m: Triple[] }[]>;

export class RetractPreview {
  readonly voxels: ChangedVoxels;
  private asked = 0;
  private readonly api: Api;
  private readonly map: string;
  private readonly stage: Stage;

  constructor(api: Api, info: MapInfo, stage: Stage) {
    this.api = api;
    this.map = info.name;
    this.stage = stage;
    this.voxels = new ChangedVoxels(voxelSizeOf(info.geometry));
    stage.add(this.voxels.group);
  }

  /** Show what a retract would change; the same in words. */
  async show(body: RetractRequest): Promise<string> {
    const mine = ++this.asked;
    const changes = await this.api.post<RetractChanges>(`maps/${this.map}/main/changes`, body);
    if (mine !== this.asked) return "";
    const ways = (Object.keys(WAYS) as Way[]).filter((way) => changes.counts[way] > 0);
    this.voxels.show(ways.map((way) => ({ colour: WAYS[way][0], centresM: changes[way].flatMap(({ centres_m }) => centres_m), isThere: way !== "appeared" })), isShown);
    this.stage.draw();
    if (!ways.length) return changes.commits ? "Nothing that is shown changes: others saw the same." : "Nothing changes: they are not in the map.";
    return `In the map ${ways.map((way) => `${counted(changes.counts[way], "voxel", "voxels")} ${WAYS[way][1]}`).join(", ")}. Escape leaves all as it is.`;
  }

  hide(): void {
    this.asked++;
    if (!this.voxels.count) return;
    this.voxels.clear();
    this.stage.draw();
  }

  dispose(): void {
    this.asked++;
    this.voxels.dispose();
  }
}
