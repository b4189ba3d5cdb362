//! The `unshaken` program.

fn main() -> std::process::ExitCode {
    unshaken::cli::run()
}
