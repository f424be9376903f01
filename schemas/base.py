"""What every model shares: unknown keys are refused and values do not change after they were checked."""

from pydantic import BaseModel, ConfigDict


class Model(BaseModel):
    """Base of all seamosaic models: strict about keys, immutable, finite numbers only."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
