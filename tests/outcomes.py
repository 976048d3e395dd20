"""Made-up outcomes of episodes, without contradictions."""

from manifeel_ms3.evaluation.rollout import EpisodeOutcome


def made_up(seed: int, won: bool, length: int = 9, force: float = 1.0, at_end: bool | None = None) -> EpisodeOutcome:
    """An episode that ran to the time limit, and succeeded at its first step or never."""
    return EpisodeOutcome(
        seed=seed,
        success_once=won,
        success_at_end=won if at_end is None else at_end,
        fail_at_end=False,
        first_success=1 if won else None,
        return_=0.5 * length,
        reward=0.5,
        episode_len=length,
        peak_contact_force=force,
        force_until_success=force if won else None,
        inference_ms=1.0,
        ending="success" if won else "time-out",
    )
