//! What the decoder read of a raw file's notes, as fields of EXIF data: files that are no TIFF within (CR3, RAF, RW2, ORF) tell rawler alone.

use exif::{Field, In, Rational, SRational, Tag, Value};
use rawler::decoders::RawMetadata;
use rawler::formats::tiff;

/// The fields that [`Metadata`](crate::io::metadata::Metadata) knows and those that a result inherits, where `m` has them.
pub(super) fn fields(m: &RawMetadata) -> Vec<Field> {
    let text = |v: &str| (!v.trim().is_empty()).then(|| Value::Ascii(vec![v.trim().as_bytes().to_vec()]));
    let short = |v: Option<u16>| v.map(|v| Value::Short(vec![v]));
    let long = |v: Option<u32>| v.map(|v| Value::Long(vec![v]));
    let of = |r: &tiff::Rational| Rational { num: r.n, denom: r.d };
    let ratio = |v: &Option<tiff::Rational>| v.as_ref().map(|r| Value::Rational(vec![of(r)]));
    let ratios = |v: Option<&[tiff::Rational]>| v.map(|v| Value::Rational(v.iter().map(of).collect()));
    let signed = |v: &Option<tiff::SRational>| v.as_ref().map(|r| Value::SRational(vec![SRational { num: r.n, denom: r.d }]));
    let e = &m.exif;
    let texts = [
        (Tag::Artist, &e.artist),
        (Tag::Copyright, &e.copyright),
        (Tag::DateTime, &e.modify_date),
        (Tag::DateTimeOriginal, &e.date_time_original),
        (Tag::DateTimeDigitized, &e.create_date),
        (Tag::OffsetTime, &e.offset_time),
        (Tag::OffsetTimeOriginal, &e.offset_time_original),
        (Tag::OffsetTimeDigitized, &e.offset_time_digitized),
        (Tag::SubSecTime, &e.sub_sec_time),
        (Tag::SubSecTimeOriginal, &e.sub_sec_time_original),
        (Tag::SubSecTimeDigitized, &e.sub_sec_time_digitized),
        (Tag::CameraOwnerName, &e.owner_name),
        (Tag::BodySerialNumber, &e.serial_number),
        (Tag::LensMake, &e.lens_make),
        (Tag::LensModel, &e.lens_model),
        (Tag::LensSerialNumber, &e.lens_serial_number),
    ];
    let mut found = vec![
        (Tag::Make, text(&m.make)),
        (Tag::Model, text(&m.model)),
        (Tag::Orientation, short(e.orientation)),
        (Tag::ExposureTime, ratio(&e.exposure_time)),
        (Tag::ShutterSpeedValue, signed(&e.shutter_speed_value)),
        (Tag::FNumber, ratio(&e.fnumber)),
        (Tag::PhotographicSensitivity, short(e.iso_speed_ratings)),
        (Tag::ISOSpeed, long(e.iso_speed)),
        (Tag::ExposureBiasValue, signed(&e.exposure_bias)),
        (Tag::FocalLength, ratio(&e.focal_length)),
        (Tag::LensSpecification, ratios(e.lens_spec.as_ref().map(|v| &v[..]))),
        (Tag::WhiteBalance, short(e.white_balance)),
        (Tag::Flash, short(e.flash)),
    ];
    found.extend(texts.map(|(tag, v)| (tag, v.as_deref().and_then(text))));
    if let Some(g) = &e.gps {
        let places = [(Tag::GPSLatitude, &g.gps_latitude), (Tag::GPSLongitude, &g.gps_longitude), (Tag::GPSTimeStamp, &g.gps_timestamp)];
        found.extend(places.map(|(tag, v)| (tag, ratios(v.as_ref().map(|v| &v[..])))));
        let texts = [
            (Tag::GPSLatitudeRef, &g.gps_latitude_ref),
            (Tag::GPSLongitudeRef, &g.gps_longitude_ref),
            (Tag::GPSImgDirectionRef, &g.gps_img_direction_ref),
            (Tag::GPSMapDatum, &g.gps_map_datum),
            (Tag::GPSDateStamp, &g.gps_date_stamp),
        ];
        found.extend(texts.map(|(tag, v)| (tag, v.as_deref().and_then(text))));
        found.extend([
            (Tag::GPSVersionID, g.gps_version_id.map(|v| Value::Byte(v.to_vec()))),
            (Tag::GPSAltitudeRef, g.gps_altitude_ref.map(|v| Value::Byte(vec![v]))),
            (Tag::GPSAltitude, ratio(&g.gps_altitude)),
            (Tag::GPSImgDirection, ratio(&g.gps_img_direction)),
        ]);
    }
    found.into_iter().filter_map(|(tag, value)| Some(Field { tag, ifd_num: In::PRIMARY, value: value? })).collect()
}
