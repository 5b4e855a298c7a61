/** The page's address, kept that of the view: a reload shows the same, a bookmark too, and Back undoes a flight. */

export class KeptAddress {
  private readonly now: () => string;
  private kept = "";
  private passing = "";

  /** `now`: the address that shows what is shown. */
  constructor(now: () => string) {
    this.now = now;
  }

  /** A few times a second: once the view rests, keep its address. */
  tick(isResting: boolean): void {
    const address = this.now();
    const isSame = address === this.passing;
    this.passing = address;
    if (isResting && isSame && address !== this.kept) this.keep(address);
  }

  isAt(address: string): boolean {
    return address === this.kept;
  }

  /** Another address was followed: it is kept. */
  followed(): void {
    this.kept = this.now();
  }

  /** The view goes somewhere else at once: Back comes here again. */
  leave(): void {
    this.keep(this.now());
    history.pushState(null, "", this.kept);
  }

  private keep(address: string): void {
    this.kept = address;
    history.replaceState(null, "", address);
  }
}
