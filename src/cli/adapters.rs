//! `unshaken adapters`.

/// Lists the adapters, the one that would be used marked with a star.
pub(super) fn run() -> anyhow::Result<()> {
    for adapter in crate::gpu::list_adapters()? {
        println!("{} {}", if adapter.chosen { '*' } else { ' ' }, adapter.description);
    }
    Ok(())
}
