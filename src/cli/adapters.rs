//! `unshaken adapters`.

pub(super) fn run() -> anyhow::Result<()> {
    anyhow::bail!("adapters is not built yet")
}
