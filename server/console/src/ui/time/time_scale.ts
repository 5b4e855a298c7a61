/** Times as places on an axis, with long gaps in which nothing happened folded to a little.
 *
 *     |..|.||||~|...||.|~|||      ~ is a fold: a night takes as much room as a breath
 *
 * A gap is folded if it is far longer than the others and would take a good part of the axis. Places go from 0 to 1. */

/** A gap is folded if it is so many times the mean of those that are shorter, and such a part of all of them together. */
const TIMES_MEAN = 10;
const PART = 1 / 6;
/** Room of all folds together, and of one at most, as parts of the axis. */
const FOLDS_PART = 0.3;
const FOLD_PART = 0.04;

interface Stretch {
  readonly fromS: number;
  readonly toS: number;
  readonly begin: number;
  readonly end: number;
  readonly isFold: boolean;
}

export interface Fold {
  readonly begin: number;
  readonly end: number;
  readonly lengthS: number;
}

export class TimeScale {
  private readonly stretches: readonly Stretch[];

  /** `timesS`: when something happened, rising. */
  constructor(timesS: readonly number[]) {
    this.stretches = stretchesOf(timesS);
  }

  get fromS(): number {
    return this.stretches[0]!.fromS;
  }

  get toS(): number {
    return this.stretches[this.stretches.length - 1]!.toS;
  }

  get folds(): Fold[] {
    return this.stretches.filter(({ isFold }) => isFold).map(({ begin, end, fromS, toS }) => ({ begin, end, lengthS: toS - fromS }));
  }

  /** Place of a time; what is before or after all lies at an end. */
  place(timeS: number): number {
    const found = this.stretches.find(({ toS }) => timeS <= toS) ?? this.stretches[this.stretches.length - 1]!;
    const part = found.toS > found.fromS ? (timeS - found.fromS) / (found.toS - found.fromS) : 0;
    return found.begin + Math.min(Math.max(part, 0), 1) * (found.end - found.begin);
  }

  /** Time at a place. */
  time(place: number): number {
    const found = this.stretches.find(({ end }) => place <= end) ?? this.stretches[this.stretches.length - 1]!;
    const part = found.end > found.begin ? (place - found.begin) / (found.end - found.begin) : 0;
    return found.fromS + Math.min(Math.max(part, 0), 1) * (found.toS - found.fromS);
  }

  /** Round times between two places, some so many of them, none in a fold. */
  ticks(from: number, to: number, count: number): number[] {
    const shown = this.stretches.filter(({ isFold, begin, end }) => !isFold && end >= from && begin <= to);
    const spanS = shown.reduce((sum, { fromS, toS }) => sum + toS - fromS, 0) * Math.min(1, (to - from) / Math.max(shownPart(shown), 1e-9));
    const stepS = STEPS_S.find((step) => spanS / step <= count) ?? STEPS_S[STEPS_S.length - 1]!;
    const found: number[] = [];
    for (const { fromS, toS } of shown) {
      const firstS = Math.max(fromS, this.time(from));
      const lastS = Math.min(toS, this.time(to));
      for (let timeS = Math.ceil(firstS / stepS) * stepS; timeS <= lastS && found.length < 4 * count; timeS += stepS) found.push(timeS);
    }
    return found;
  }
}

const STEPS_S = [1, 2, 5, 10, 30, 60, 120, 300, 600, 1800, 3600, 7200, 21_600, 43_200, 86_400, 7 * 86_400, 30 * 86_400, 365 * 86_400];

function shownPart(stretches: readonly Stretch[]): number {
  return stretches.reduce((sum, { begin, end }) => sum + end - begin, 0);
}

function stretchesOf(timesS: readonly number[]): Stretch[] {
  const times = [...new Set(timesS)];
  if (!times.length) times.push(0);
  const gaps = times.slice(1).map((timeS, n) => ({ n, lengthS: timeS - times[n]! }));
  const folded = foldedGaps(gaps);
  const busyS = gaps.reduce((sum, { n, lengthS }) => (folded.has(n) ? sum : sum + lengthS), 0);
  const foldPart = folded.size ? Math.min(FOLD_PART, FOLDS_PART / folded.size) : 0;
  const busyPart = 1 - foldPart * folded.size;
  const found: Stretch[] = [];
  let fromS = times[0]!;
  let begin = 0;
  const close = (toS: number) => {
    const end = busyS > 0 ? begin + ((toS - fromS) / busyS) * busyPart : begin + (folded.size ? 0 : 1);
    found.push({ fromS, toS, begin, end, isFold: false });
    begin = end;
  };
  for (const { n } of gaps) {
    if (!folded.has(n)) continue;
    close(times[n]!);
    found.push({ fromS: times[n]!, toS: times[n + 1]!, begin, end: begin + foldPart, isFold: true });
    begin += foldPart;
    fromS = times[n + 1]!;
  }
  close(times[times.length - 1]!);
  return found;
}

/** Numbers of the gaps that are folded: the longest first, while they stand out. */
function foldedGaps(gaps: readonly { n: number; lengthS: number }[]): Set<number> {
  const longest = [...gaps].sort((a, b) => b.lengthS - a.lengthS);
  const found = new Set<number>();
  let leftS = gaps.reduce((sum, { lengthS }) => sum + lengthS, 0);
  for (const [rank, { n, lengthS }] of longest.entries()) {
    leftS -= lengthS;
    const meanS = leftS / Math.max(longest.length - rank - 1, 1);
    if (leftS <= 0 || lengthS <= TIMES_MEAN * meanS || lengthS <= PART * leftS) break;
    found.add(n);
  }
  return found;
}
