#!/bin/sh
# For RUSTC_WRAPPER: the compiler, with libFuzzer's coverage for the crates that are fuzzed (not as parts of build scripts, which have no
# fuzzer to report to; only what they are not part of is compiled with --target).
case " $* " in
*" --target "*) ;;
*) exec "$@" ;;
esac
case " $* " in
*" --crate-name unshaken "* | *" --crate-name exr "* | *" --crate-name radiance "* | *" --crate-name picture "* | *" --crate-name raw "* | \
    *" --crate-name icc "* | *" --crate-name exif "* | *" --crate-name response "* | *" --crate-name tsf "* | *" --crate-name toml "* | \
    *" --crate-name moxcms "*)
    exec "$@" -Cpasses=sancov-module -Cllvm-args=-sanitizer-coverage-level=4 -Cllvm-args=-sanitizer-coverage-inline-8bit-counters \
        -Cllvm-args=-sanitizer-coverage-pc-table -Cllvm-args=-sanitizer-coverage-trace-compares --cfg fuzzing
    ;;
*) exec "$@" ;;
esac
